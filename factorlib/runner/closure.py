"""The source a stage depends on: its module and everything of the project it imports, however far.

Each module is hashed by its syntax tree without comments and docstrings, so that a remark reruns nothing.  Imports are
found anywhere in a module, inside functions too; modules named only at run time (`import_module(name)`) are not seen.
"""

from __future__ import annotations

import ast
import hashlib
import sys
from pathlib import Path

import msgspec

from factorlib.errors import InputError, did_you_mean
from factorlib.runner.filehash import FileHashes

DATA = {".safetensors", ".html", ".j2", ".css", ".js"}  # package data that counts as source


class Source(msgspec.Struct, frozen=True):
    """What one module's text says.

    digest:  of its syntax tree;  imports: dotted names as imported;  params: fields of its class Params, if it has one
    """

    digest: str
    imports: list[str]
    params: list[str] | None


class Closure(msgspec.Struct, frozen=True):
    """modules: dotted name -> digest;  data: path in its package -> digest;  external: top-level names outside the project."""

    modules: dict[str, str]
    data: dict[str, str]
    external: list[str]


def source_of(text: str, module: str, is_package: bool) -> Source:
    """Raises SyntaxError."""
    tree = ast.parse(text)
    imports = sorted({name for node in ast.walk(tree) for name in _imported(node, module, is_package)})
    params = _params_of(tree)
    for node in ast.walk(tree):
        _drop_docstring(node)
    return Source(hashlib.sha256(ast.dump(tree).encode()).hexdigest()[:32], imports, params)


def _imported(node: ast.AST, module: str, is_package: bool) -> list[str]:
    if isinstance(node, ast.Import):
        return [alias.name for alias in node.names]
    if isinstance(node, ast.ImportFrom):
        base = node.module or ""
        if node.level:
            parts = module.split(".") if is_package else module.split(".")[:-1]
            parts = parts[: len(parts) - node.level + 1]
            base = ".".join([*parts, base] if base else parts)
        return [base, *(f"{base}.{alias.name}" for alias in node.names)]
    return []


def _params_of(tree: ast.Module) -> list[str] | None:
    for node in tree.body:
        if isinstance(node, ast.ClassDef) and node.name == "Params":
            return [item.target.id for item in node.body if isinstance(item, ast.AnnAssign) and isinstance(item.target, ast.Name)]
    return None


def _drop_docstring(node: ast.AST) -> None:
    if (
        isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef)
        and ast.get_docstring(node, clean=False) is not None
    ):
        node.body = node.body[1:] or [ast.Pass()]


class Sources:
    """The modules below some root folders, read through a cache of file hashes."""

    def __init__(self, roots: list[Path], hashes: FileHashes):
        self.roots, self.hashes = list(dict.fromkeys(roots)), hashes
        self._found: dict[str, Path | None] = {}

    def stage_params(self, package: str, stage: str, pipeline_file: Path) -> list[str]:
        """Names of a stage's parameters, read without importing it."""
        return self._source(f"{package}.{stage}", self._stage_file(package, stage, pipeline_file)).params or []

    def closure(self, package: str, stage: str, pipeline_file: Path) -> Closure:
        first = f"{package}.{stage}"
        self._stage_file(package, stage, pipeline_file)
        seen: dict[str, Path] = {}
        external: set[str] = set()
        stack = [first]
        while stack:
            name = stack.pop()
            for part in _with_parents(name):
                if part in seen:
                    continue
                file = self.find(part)
                if file is None:
                    if part == name.split(".")[0]:
                        external.add(part)
                    break
                seen[part] = file
                stack += self._source(part, file).imports
        modules = {name: self._source(name, file).digest for name, file in sorted(seen.items()) if file.name.endswith(".py")}
        return Closure(modules, self._data(seen), sorted(external - sys.stdlib_module_names - {""}))

    def find(self, name: str) -> Path | None:
        """The file of a module of the project; a folder without `__init__.py` stands for itself."""
        if name not in self._found:
            self._found[name] = self._find(name)
        return self._found[name]

    def _find(self, name: str) -> Path | None:
        parent, _, last = name.rpartition(".")
        if parent:
            above = self.find(parent)
            bases = [] if above is None else [above.parent] if above.name == "__init__.py" else [above] if above.is_dir() else []
        else:
            bases = self.roots
        for base in bases:
            for file in (base / last / "__init__.py", base / f"{last}.py"):
                if file.is_file():
                    return file
            if (base / last).is_dir() and any((base / last).glob("*.py")):
                return base / last
        return None

    def _stage_file(self, package: str, stage: str, pipeline_file: Path) -> Path:
        file = self.find(f"{package}.{stage}")
        if file is None:
            folder = self.roots[0] / package
            known = [p.stem for p in folder.glob("*.py") if p.stem != "__init__"]
            raise InputError(
                f"the stage {stage!r} has no module {package}/{stage}.py",
                file=pipeline_file,
                key=f"stages.{stage}",
                cure=did_you_mean(stage, known),
            )
        return file

    def _source(self, name: str, file: Path) -> Source:
        if file.is_dir():
            return Source("", [], None)
        return self.hashes.source(file, lambda: self._parse(name, file))

    @staticmethod
    def _parse(name: str, file: Path) -> Source:
        try:
            return source_of(file.read_text(encoding="utf-8"), name, file.name == "__init__.py")
        except SyntaxError as error:
            raise InputError(f"not Python: {error.msg}", file=f"{file}:{error.lineno}", cure="mend that line") from error

    def _data(self, modules: dict[str, Path]) -> dict[str, str]:
        """Weights and templates beside the modules, or in folders beside them that are no packages."""
        packages = {
            name.rpartition(".")[0]: file.parent for name, file in modules.items() if not file.is_dir() and file.name != "__init__.py"
        }
        packages |= {name: file.parent for name, file in modules.items() if file.name == "__init__.py"}
        packages.pop("", None)  # beside a module that is in no package lies anything
        files = {f"{name}:{path.relative_to(folder).as_posix()}": path for name, folder in packages.items() for path in _data_files(folder)}
        return {name: self.hashes.content(path) for name, path in sorted(files.items())}


def _with_parents(name: str) -> list[str]:
    parts = name.split(".")
    return [".".join(parts[: k + 1]) for k in range(len(parts))]


def _data_files(folder: Path) -> list[Path]:
    files = []
    for path in sorted(folder.iterdir()):
        if path.suffix in DATA and path.is_file():
            files.append(path)
        elif path.is_dir() and path.name != "__pycache__" and not (path / "__init__.py").exists():
            files += _data_files(path)
    return files
