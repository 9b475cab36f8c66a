"""The source that a stage depends on: its module and all modules of the project that it imports, however indirectly.

Each module is hashed by its syntax tree without comments and docstrings, so that a remark reruns nothing.  Imports
count wherever they stand; modules named only at run time (`import_module(name)`) are not found.  Every data file beside
an imported module, or in a folder beside it that is not a package, counts too, but for temporary ones (`is_temporary`).

A module declares what else its numbers depend on in constants, which are read from its syntax tree:

    ENVIRONMENT = ("FACTORLIB_FUSED",)    environment variables; their values count
    PROGRAMS = {"CC": "cc"}               programs: the variable that names one, and its default; presence and name
                                          count, the folder does not
"""

import ast
import hashlib
import os
import shutil
import sys
from collections.abc import Iterator
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import msgspec

from factorlib.errors import InputError, did_you_mean
from factorlib.runner.store import FileHashes, is_temporary

# fields of a record that come from a closure
CODE = ("source:", "data:", "environment:", "program:", "package:", "python")
OURS = ("factorlib", "stages", "studies")  # packages of this project; other folders beside an installed one are not


class Source(msgspec.Struct, frozen=True):
    """Digest of one module's syntax tree, its imports, and the dependencies that it declares."""

    digest: str = ""
    imports: list[str] = []
    environment: list[str] = []
    programs: dict[str, str] = {}


class Closure(msgspec.Struct, frozen=True):
    """Source, package data, versions and environment that a stage depends on.

    record: fields of a step's record
    files:  path of each field that is the hash of a file
    """

    record: dict[str, str]
    files: dict[str, Path]


def source_of(text: str, module: str, is_package: bool) -> Source:
    """Parse the text of a module; SyntaxError if it is not Python, InputError for a malformed declaration."""
    tree = ast.parse(text)
    imports = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            imports |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            above = module.split(".")[: None if is_package else -1] if node.level else []
            base = ".".join([*above[: len(above) - node.level + 1], *([node.module] if node.module else [])])
            imports |= {base, *(f"{base}.{alias.name}" for alias in node.names)}
    environment = _constant(tree, "ENVIRONMENT", list[str], '("A_VARIABLE",)') or []
    programs = _constant(tree, "PROGRAMS", dict[str, str], '{"CC": "cc"}') or {}
    for node in ast.walk(tree):
        if (body := getattr(node, "body", None)) and isinstance(body, list):  # The body of a lambda is an expression.
            body[:] = [item for item in body if not _is_docstring(item)] or [ast.Pass()]
    digest = hashlib.sha256(ast.dump(tree).encode()).hexdigest()[:32]
    return Source(digest, sorted(imports), environment, programs)


def _constant(tree: ast.Module, name: str, type_: Any, example: str) -> Any:
    """Return the value of a module's constant without running the module; None if there is no such constant."""
    for node in tree.body:
        if isinstance(node, ast.Assign) and any(getattr(target, "id", None) == name for target in node.targets):
            try:
                return msgspec.convert(ast.literal_eval(node.value), type_)
            except (ValueError, msgspec.ValidationError):
                fault = f"line {node.lineno}: {name} must be a literal, because it is read without running the module"
                raise InputError(fault, key=name, cure=f"write {name} = {example}") from None
    return None


def _is_docstring(item: ast.stmt) -> bool:
    """Return True for a string that is a statement of its own: a docstring, or the description of a field."""
    return isinstance(item, ast.Expr) and isinstance(item.value, ast.Constant) and isinstance(item.value.value, str)


class Sources:
    """Modules below root folders: of the project, and of the library if that lies elsewhere."""

    def __init__(self, roots: list[Path], hashes: FileHashes):
        self.roots = list(dict.fromkeys(roots))
        self.hashes = hashes
        self._modules: dict[str, Path | None] = {}
        self._sources: dict[Path, Source] = {}  # Each file is parsed once, however many stages import it.
        self._data: dict[Path, list[Path]] = {}  # data files by folder

    def closure(self, package: str, stage: str, pipeline_file: Path) -> Closure:
        """Return the closure of the module `package.stage`.

        Raises:
            InputError: The stage has no module, or a module of the project is not Python.
        """
        if self.find(f"{package}.{stage}") is None:
            known = [p.stem for p in (self.roots[0] / package).glob("*.py") if p.stem != "__init__"]
            fault = f"the stage {stage!r} has no module {package}/{stage}.py"
            raise InputError(fault, file=pipeline_file, key=f"stages.{stage}", cure=did_you_mean(stage, known))
        modules, external = self._reach(f"{package}.{stage}")
        sources = {name: self._source(name, file) for name, file in modules.items() if file.name.endswith(".py")}
        record = {f"source:{name}": source.digest for name, source in sources.items()}
        packages = {n if modules[n].name == "__init__.py" else n.rpartition(".")[0]: modules[n].parent for n in sources}
        packages.pop("", None)  # Beside a module that is in no package lie unrelated files.
        data: dict[str, Path] = {}
        for name, folder in packages.items():
            if folder not in self._data:
                self._data[folder] = list(_data_files(folder))
            data |= {f"data:{name}:{path.relative_to(folder).as_posix()}": path for path in self._data[folder]}
        record |= {name: self.hashes.content(path) for name, path in data.items()}
        for source in sources.values():
            record |= {f"environment:{name}": os.environ[name] for name in source.environment if name in os.environ}
            commands = {name: os.environ.get(name, usual).split() or [""] for name, usual in source.programs.items()}
            for name, (program, *options) in commands.items():
                if shutil.which(program):
                    record[f"program:{name}"] = " ".join([Path(program).name, *options])
        for name in sorted(external - sys.stdlib_module_names):  # A module of no distribution does not count.
            record |= {f"package:{each}": version for each, version in self.versions.get(name, {}).items()}
        record["python"] = f"{sys.version_info[0]}.{sys.version_info[1]}"
        return Closure(record, {f"source:{name}": modules[name] for name in sources} | data)

    def _reach(self, root: str) -> tuple[dict[str, Path], set[str]]:
        """Return the files of all modules of the project that `root` imports, by name, and external packages."""
        modules: dict[str, Path] = {}
        external: set[str] = set()
        stack = [root]
        while stack:
            parts = stack.pop().split(".")
            for part in (".".join(parts[: k + 1]) for k in range(len(parts))):
                if part in modules:
                    continue
                if (file := self.find(part)) is None:
                    external |= {part} if part == parts[0] else set()
                    break
                modules[part] = file
                stack += self._source(part, file).imports
        return dict(sorted(modules.items())), external

    @cached_property
    def versions(self) -> dict[str, dict[str, str]]:
        """Versions as {imported name: {distribution: version}}, cached until a folder of packages changes."""
        folders = [path for path in sys.path if path.endswith("-packages") and os.path.isdir(path)]
        newest = max(folders, key=os.path.getmtime, default=sys.prefix)
        return self.hashes.cached("packages", Path(newest), _installed, dict[str, dict[str, str]])

    def find(self, name: str) -> Path | None:
        """Return the file of a module of the project, or the folder of a package without `__init__.py`."""
        if name not in self._modules:
            parent, _, last = name.rpartition(".")
            bases = self.roots[: None if name in OURS else 1]
            if parent:
                above = self.find(parent)
                bases = [] if above is None else [above.parent if above.name == "__init__.py" else above]
            self._modules[name] = next((file for base in bases if (file := _module_in(base, last))), None)
        return self._modules[name]

    def _source(self, name: str, file: Path) -> Source:
        def parse() -> Source:
            """Parse the file; a syntax error is the user's to correct."""
            try:
                return source_of(file.read_text(encoding="utf-8"), name, file.name == "__init__.py")
            except SyntaxError as error:
                place = f"{file}:{error.lineno}"
                raise InputError(f"not Python: {error.msg}", file=place, cure="correct that line") from error
            except InputError as error:
                raise InputError(error.fault, file=file, key=error.key, cure=error.cure) from error

        if file not in self._sources:
            self._sources[file] = Source() if file.is_dir() else self.hashes.cached("source", file, parse, Source)
        return self._sources[file]


def _module_in(folder: Path, name: str) -> Path | None:
    for file in (folder / name / "__init__.py", folder / f"{name}.py"):
        if file.is_file():
            return file
    return folder / name if (folder / name).is_dir() and any((folder / name).glob("*.py")) else None


def _data_files(folder: Path) -> Iterator[Path]:
    for path in sorted(path for path in folder.iterdir() if not is_temporary(path.name)):
        if path.is_dir():
            yield from () if (path / "__init__.py").exists() else _data_files(path)
        elif path.is_file() and path.suffix != ".py":
            yield path


@cache
def _installed() -> dict[str, dict[str, str]]:
    """Return {imported name: {distribution: version}} of all installed packages."""
    from importlib.metadata import packages_distributions, version

    distributions = packages_distributions()
    return {name: {each: version(each) for each in sorted({*names})} for name, names in distributions.items()}
