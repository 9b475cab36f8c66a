"""The source a stage depends on: its module and everything of the project it imports, however far.

Each module is hashed by its syntax tree without comments and docstrings, so that a remark reruns nothing.  Imports
count wherever they stand; modules named only at run time (`import_module(name)`) are not seen.  So does every file
beside an imported module, or in a folder beside it that is no package, but for what Python and editors leave there
(`left_over`).

What else a module's numbers depend on it declares in constants, which are read from its syntax tree:

    ENVIRONMENT = ("FACTORLIB_FUSED",)    environment variables; their values count
    PROGRAMS = {"CC": "cc"}               programs by the variable that names them, and the usual one; whether it is
                                          there counts, and its name, not where it lies
"""

from __future__ import annotations

import ast
import hashlib
import os
import shutil
import sys
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import Any

import msgspec

from factorlib.errors import InputError, did_you_mean
from factorlib.runner.store import FileHashes, left_over

# the fields of a record that a closure makes
CODE = ("source:", "data:", "environment:", "program:", "package:", "python")
OURS = ("factorlib", "stages", "studies")  # packages; an installed one lies among those of others


class Source(msgspec.Struct, frozen=True):
    """Digest of one module's syntax tree, its imports, and the dependencies that it declares."""

    digest: str = ""
    imports: list[str] = []
    environment: list[str] = []
    programs: dict[str, str] = {}


class Closure(msgspec.Struct, frozen=True):
    """Source, package data, versions and environment that a stage depends on, as a part of a step's record.

    It also has the paths of these files.
    """

    record: dict[str, str]
    files: dict[str, Path]


def source_of(text: str, module: str, is_package: bool) -> Source:
    """Read what a module's text says.  Raises SyntaxError, and InputError for a declaration that is none."""
    tree = ast.parse(text)
    imports = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            imports |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            above = module.split(".")[: None if is_package else -1] if node.level else []
            base = ".".join([*above[: len(above) - node.level + 1], *([node.module] if node.module else [])])
            imports |= {base, *(f"{base}.{alias.name}" for alias in node.names)}
    environment = _declared(tree, "ENVIRONMENT", list[str], '("A_VARIABLE",)') or []
    programs = _declared(tree, "PROGRAMS", dict[str, str], '{"CC": "cc"}') or {}
    for node in ast.walk(tree):
        if (body := getattr(node, "body", None)) and isinstance(body, list):  # a lambda's is one expression
            body[:] = [item for item in body if not _is_remark(item)] or [ast.Pass()]
    digest = hashlib.sha256(ast.dump(tree).encode()).hexdigest()[:32]
    return Source(digest, sorted(imports), environment, programs)


def _declared(tree: ast.Module, name: str, type_: Any, example: str) -> Any:
    """Return the value of the constant `name` of a module, without running it; None where it has none."""
    for node in tree.body:
        if isinstance(node, ast.Assign) and any(getattr(target, "id", None) == name for target in node.targets):
            try:
                return msgspec.convert(ast.literal_eval(node.value), type_)
            except (ValueError, msgspec.ValidationError):
                words = f"line {node.lineno}: {name} is read without running the module"
                raise InputError(words, key=name, cure=f"write names as they stand: {example}") from None
    return None


def _is_remark(item: ast.stmt) -> bool:
    """Return whether a statement is a string that stands alone: a docstring, or what is said of a field."""
    return isinstance(item, ast.Expr) and isinstance(item.value, ast.Constant) and isinstance(item.value.value, str)


class Sources:
    """Modules below some root folders (the project, the library where it lies elsewhere), by a cache of file hashes."""

    def __init__(self, roots: list[Path], hashes: FileHashes):
        self.roots, self.hashes = list(dict.fromkeys(roots)), hashes
        self._places: dict[str, Path | None] = {}
        self._read: dict[Path, Source] = {}  # each file is looked at once, however many stages import it
        self._beside: dict[Path, list[Path]] = {}  # data files by folder

    def closure(self, package: str, stage: str, pipeline_file: Path) -> Closure:
        """Return all modules of the project that `stage` imports, with their hashes.

        The installed packages among its imports are returned, too.
        Raises InputError where the stage has no module, or a module of the project cannot be parsed.
        """
        if self.find(f"{package}.{stage}") is None:
            known = [p.stem for p in (self.roots[0] / package).glob("*.py") if p.stem != "__init__"]
            words, cure = f"the stage {stage!r} has no module {package}/{stage}.py", did_you_mean(stage, known)
            raise InputError(words, file=pipeline_file, key=f"stages.{stage}", cure=cure)
        places: dict[str, Path] = {}
        external: set[str] = set()
        stack = [f"{package}.{stage}"]
        while stack:
            parts = stack.pop().split(".")
            for part in (".".join(parts[: k + 1]) for k in range(len(parts))):
                if part in places:
                    continue
                file = self.find(part)
                if file is None:
                    external |= {part} if part == parts[0] else set()
                    break
                places[part] = file
                stack += self._source(part, file).imports
        sources = {name: self._source(name, file) for name, file in sorted(places.items()) if file.name.endswith(".py")}
        packages = {n if places[n].name == "__init__.py" else n.rpartition(".")[0]: places[n].parent for n in sources}
        packages.pop("", None)  # beside a module that is in no package lies anything
        data: dict[str, Path] = {}
        for name, folder in packages.items():
            if folder not in self._beside:
                self._beside[folder] = list(_data_files(folder))
            data |= {f"data:{name}:{path.relative_to(folder).as_posix()}": path for path in self._beside[folder]}
        record = {f"source:{name}": source.digest for name, source in sources.items()}
        record |= {name: self.hashes.content(path) for name, path in data.items()}
        for source in sources.values():
            record |= {f"environment:{name}": os.environ[name] for name in source.environment if name in os.environ}
            for name, default in source.programs.items():
                command = os.environ.get(name, default).split() or [""]
                if shutil.which(command[0]):  # without the folder it lies in
                    record[f"program:{name}"] = " ".join([Path(command[0]).name, *command[1:]])
        files = {f"source:{name}": places[name] for name in sources} | data
        for name in sorted(external - sys.stdlib_module_names):  # what belongs to no distribution is left out
            record |= {f"package:{each}": version for each, version in self.versions.get(name, {}).items()}
        return Closure(record | {"python": f"{sys.version_info[0]}.{sys.version_info[1]}"}, files)

    @cached_property
    def versions(self) -> dict[str, dict[str, str]]:
        """{name as imported: {distribution: version}}, looked up once per state of the folders of packages."""
        folders = [path for path in sys.path if path.endswith("-packages") and os.path.isdir(path)]
        newest = max(folders, key=os.path.getmtime, default=sys.prefix)
        return self.hashes.remembered("packages", Path(newest), _installed, dict[str, dict[str, str]])

    def find(self, name: str) -> Path | None:
        """Return the file of a module of the project; a folder without `__init__.py` stands for itself."""
        if name not in self._places:
            parent, _, last = name.rpartition(".")
            bases = self.roots[: None if name in OURS else 1]
            if parent:
                above = self.find(parent)
                bases = [] if above is None else [above.parent if above.name == "__init__.py" else above]
            self._places[name] = next((file for base in bases if (file := _module_in(base, last))), None)
        return self._places[name]

    def _source(self, name: str, file: Path) -> Source:
        def parse() -> Source:
            try:
                return source_of(file.read_text(encoding="utf-8"), name, file.name == "__init__.py")
            except SyntaxError as error:
                where = f"{file}:{error.lineno}"
                raise InputError(f"not Python: {error.msg}", file=where, cure="mend that line") from error
            except InputError as error:
                raise InputError(error.found, file=file, key=error.key, cure=error.cure) from error

        if file not in self._read:
            self._read[file] = Source() if file.is_dir() else self.hashes.remembered("source", file, parse, Source)
        return self._read[file]


def _module_in(folder: Path, name: str) -> Path | None:
    for file in (folder / name / "__init__.py", folder / f"{name}.py"):
        if file.is_file():
            return file
    return folder / name if (folder / name).is_dir() and any((folder / name).glob("*.py")) else None


def _data_files(folder: Path) -> Iterator[Path]:
    for path in sorted(path for path in folder.iterdir() if not left_over(path.name)):
        if path.is_dir():
            yield from () if (path / "__init__.py").exists() else _data_files(path)
        elif path.is_file() and path.suffix != ".py":
            yield path


def _installed() -> dict[str, dict[str, str]]:
    """{name as imported: {distribution: version}} of all that is installed."""
    from importlib.metadata import packages_distributions, version

    found = packages_distributions()
    return {name: {each: version(each) for each in sorted({*names})} for name, names in found.items()}
