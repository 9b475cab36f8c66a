"""The source a stage depends on: its module and everything of the project it imports, however far.

Each module is hashed by its syntax tree without comments and docstrings, so that a remark reruns nothing.  Imports are
found anywhere in a module, inside functions too; modules named only at run time (`import_module(name)`) are not seen.
Package data counts by one rule: every file that lies beside an imported module, or in a folder beside it that is no
package, and is not Python, but for what Python and editors leave there (`left_over`).

What else a module's numbers depend on it declares in constants, which are read from its syntax tree:

    ENVIRONMENT = ("FACTORLIB_FUSED",)    environment variables; their values count
    PROGRAMS = {"CC": "cc"}               programs by the variable that names them, and what stands in for it; whether
                                          there is such a program counts, and its name, not where it lies
"""

from __future__ import annotations

import ast
import hashlib
import os
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec

from factorlib.errors import InputError, did_you_mean
from factorlib.runner.filehash import FileHashes, left_over, read_cache, write_cache

# the fields of a record that a closure makes
CODE = ("source:", "data:", "environment:", "program:", "package:", "python")
OURS = ("factorlib", "stages", "studies")  # packages; an installed one lies among those of others


class Source(msgspec.Struct, frozen=True):
    """What one module's text says: a digest of its syntax tree, dotted names as it imports them, and the environment variables
    and programs that it declares its numbers to depend on.
    """

    digest: str = ""
    imports: list[str] = []
    environment: list[str] = []
    programs: dict[str, str] = {}


class Closure(msgspec.Struct, frozen=True):
    """What a stage depends on besides its inputs.

    record: the part of a step's record that is its code, and what of the environment the code declares or imports
    files:  where what `record` names lies
    """

    record: dict[str, str]
    files: dict[str, Path]


def source_of(text: str, module: str, is_package: bool) -> Source:
    """What a module's text says.  Raises SyntaxError, and InputError for a declaration that is none."""
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
        _drop_docstring(node)
    digest = hashlib.sha256(ast.dump(tree).encode()).hexdigest()[:32]
    return Source(digest, sorted(imports), environment, programs)


def _declared(tree: ast.Module, name: str, type_: Any, example: str) -> Any:
    """The value of the constant `name` of a module, without running it; None where it has none."""
    for node in tree.body:
        if isinstance(node, ast.Assign) and any(getattr(target, "id", None) == name for target in node.targets):
            try:
                return msgspec.convert(ast.literal_eval(node.value), type_)
            except (ValueError, msgspec.ValidationError):
                words = f"line {node.lineno}: {name} is read without running the module"
                raise InputError(words, key=name, cure=f"write names as they stand: {example}") from None
    return None


def _drop_docstring(node: ast.AST) -> None:
    """The docstring of a module, class or function, and the strings that follow the fields of a class."""
    documented = ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef
    if isinstance(node, documented) and ast.get_docstring(node, clean=False) is not None:
        node.body = node.body[1:] or [ast.Pass()]
    if isinstance(node, ast.ClassDef):
        values = [(item, getattr(item, "value", None) if isinstance(item, ast.Expr) else None) for item in node.body]
        texts = [item for item, value in values if isinstance(value, ast.Constant) and isinstance(value.value, str)]
        node.body = [item for item in node.body if item not in texts] or [ast.Pass()]


class Sources:
    """The modules below some root folders, read through a cache of file hashes.  cache: of versions of packages"""

    def __init__(self, roots: list[Path], hashes: FileHashes, cache: Path | None = None):
        self.roots, self.hashes, self.packages = list(dict.fromkeys(roots)), hashes, Packages(cache)
        self._places: dict[str, Path | None] = {}
        self._read: dict[Path, Source] = {}  # each file is looked at once, however many stages import it
        self._beside: dict[Path, list[Path]] = {}  # data files by folder

    def closure(self, package: str, stage: str, pipeline_file: Path) -> Closure:
        """All modules of the project that `stage` imports, with their hashes, and the installed packages among its imports.

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
        data = {}
        for name, folder in packages.items():
            if folder not in self._beside:
                self._beside[folder] = list(_data_files(folder))
            data |= {f"data:{name}:{path.relative_to(folder).as_posix()}": path for path in self._beside[folder]}
        record = {f"source:{name}": source.digest for name, source in sources.items()}
        record |= {name: self.hashes.content(path) for name, path in data.items()}
        for source in sources.values():
            record |= {f"environment:{name}": os.environ[name] for name in source.environment if name in os.environ}
            for name, default in source.programs.items():
                words = os.environ.get(name, default).split() or [""]
                if shutil.which(words[0]):  # without the folder it lies in
                    record[f"program:{name}"] = " ".join([Path(words[0]).name, *words[1:]])
        files = {f"source:{name}": places[name] for name in sources} | data
        versions = self.packages.versions(sorted(external - sys.stdlib_module_names - {""}))
        record |= {f"package:{package}": version for package, version in versions.items()}
        return Closure(record | {"python": f"{sys.version_info[0]}.{sys.version_info[1]}"}, files)

    def find(self, name: str) -> Path | None:
        """The file of a module of the project; a folder without `__init__.py` stands for itself."""
        if name not in self._places:
            parent, _, last = name.rpartition(".")
            above = self.find(parent) if parent else None
            of_package = above is not None and above.name == "__init__.py"
            bases = (
                [above.parent if of_package else above]
                if above
                else []
                if parent
                else self.roots[: None if name in OURS else 1]
            )
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


class Packages:
    """Versions of the installed packages that are imported, looked up once per state of site-packages."""

    def __init__(self, cache: Path | None):
        folders = [path for path in sys.path if path.endswith("-packages") and os.path.isdir(path)]
        self.cache, self.state = cache, [[path, os.stat(path).st_mtime_ns] for path in folders]
        state, known = read_cache(cache, tuple[list, dict[str, dict[str, str]]]) or ([], {})
        self.known = known if state == self.state else {}

    def versions(self, imports: list[str]) -> dict[str, str]:
        """{distribution: version} by names as imported; what belongs to no distribution is left out."""
        if missing := [name for name in imports if name not in self.known]:
            from importlib.metadata import packages_distributions, version

            of = packages_distributions()
            self.known |= {name: {each: version(each) for each in sorted(set(of.get(name, [])))} for name in missing}
            if self.cache is not None:
                write_cache(self.cache, (self.state, self.known))
        return {name: version for each in imports for name, version in self.known[each].items()}
