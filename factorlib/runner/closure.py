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
import shlex
import shutil
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec

from factorlib.errors import InputError, did_you_mean
from factorlib.runner.defaults import Names, defaults_of, names_of, values_of
from factorlib.runner.filehash import FileHashes, left_over

KINDS = ("source:", "data:", "environment:", "program:")  # the fields of a record that a closure makes


class Source(msgspec.Struct, frozen=True):
    """What one module's text says.

    digest:  of its syntax tree;  imports: dotted names as imported
    names:   its classes and where its names come from
    environment, programs: what it declares its numbers to depend on
    """

    digest: str
    imports: list[str]
    names: Names
    environment: list[str]
    programs: dict[str, str]


class Closure(msgspec.Struct, frozen=True):
    """modules: dotted name -> digest;  data: path in its package -> digest;  external: top-level names outside the project;
    environment, programs: as the modules declare them;  files: where each module and each piece of data lies."""

    modules: dict[str, str]
    data: dict[str, str]
    external: list[str]
    environment: list[str]
    programs: dict[str, str]
    files: dict[str, Path]

    def record(self) -> dict[str, str]:
        """The part of a step's record that is its code, and the environment variables that the code reads, as they are now."""
        record = {f"source:{module}": digest for module, digest in self.modules.items()}
        record |= {f"data:{file}": digest for file, digest in self.data.items()}
        record |= {f"environment:{name}": os.environ[name] for name in self.environment if name in os.environ}
        return record | {
            f"program:{name}": found for name, default in self.programs.items() if (found := _program(name, default))
        }

    def changes(self, record: Mapping[str, Any]) -> list[str]:
        """The names of what is not as it is in `record`."""
        now = self.record()
        before = {name: value for name, value in record.items() if name.startswith(KINDS)}
        return [name for name in sorted(before.keys() | now.keys()) if before.get(name) != now.get(name)]


def _program(name: str, default: str) -> str | None:
    """The words that name a program, without the folder it lies in; None where there is no such program."""
    command = os.environ.get(name, default)
    try:
        words = shlex.split(command) or [""]
    except ValueError as error:
        raise InputError(
            f"{command!r} is no command ({error})", key=name, cure=f"name a program, as in {name}={default}"
        ) from None
    return " ".join([Path(words[0]).name, *words[1:]]) if shutil.which(words[0]) else None


def source_of(text: str, module: str, is_package: bool) -> Source:
    """Raises SyntaxError, and InputError for a declaration that is none."""
    tree = ast.parse(text)
    imports = sorted({name for node in ast.walk(tree) for name in _imported(node, module, is_package)})
    names = names_of(tree)
    environment, programs = (
        _declared(tree, "ENVIRONMENT", list[str], []),
        _declared(tree, "PROGRAMS", dict[str, str], {}),
    )
    for node in ast.walk(tree):
        _drop_docstring(node)
    return Source(hashlib.sha256(ast.dump(tree).encode()).hexdigest()[:32], imports, names, environment, programs)


def _declared(tree: ast.Module, name: str, type_: Any, default: Any) -> Any:
    """The value of the constant `name` of a module, without running it."""
    for node in tree.body:
        if isinstance(node, ast.Assign) and any(
            isinstance(target, ast.Name) and target.id == name for target in node.targets
        ):
            try:
                return msgspec.convert(ast.literal_eval(node.value), type_)
            except (ValueError, msgspec.ValidationError):
                cure = "write names as they stand: " + (
                    '{"CC": "cc"}' if type_ == dict[str, str] else '("A_VARIABLE",)'
                )
                raise InputError(
                    f"line {node.lineno}: {name} is read without running the module", key=name, cure=cure
                ) from None
    return default


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


def _drop_docstring(node: ast.AST) -> None:
    """The docstring of a module, class or function, and the strings that follow the fields of a class."""
    if (
        isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef)
        and ast.get_docstring(node, clean=False) is not None
    ):
        node.body = node.body[1:] or [ast.Pass()]
    if isinstance(node, ast.ClassDef):
        node.body = [item for item in node.body if not _is_string(item)] or [ast.Pass()]


def _is_string(node: ast.stmt) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)


class Sources:
    """The modules below some root folders, read through a cache of file hashes."""

    def __init__(self, roots: list[Path], hashes: FileHashes):
        self.roots, self.hashes = list(dict.fromkeys(roots)), hashes
        self._found: dict[str, Path | None] = {}
        self._read: dict[Path, Source] = {}  # each file is looked at once, however many stages import it
        self._beside: dict[Path, list[Path]] = {}  # data files by folder

    def stage_params(self, package: str, stage: str, pipeline_file: Path) -> dict[str, str]:
        """A stage's parameters and their defaults as text, read without importing it."""
        self._stage_file(package, stage, pipeline_file)
        return defaults_of(f"{package}.{stage}", "Params", self._names)

    def default_values(self, package: str, stage: str) -> dict[str, Any]:
        """The same as values, a table where a default is a struct; UNKNOWN where the source does not tell it."""
        return values_of(f"{package}.{stage}", "Params", self._names)

    def _names(self, module: str) -> Names | None:
        file = self.find(module)
        return self._source(module, file).names if file else None

    def closure(self, package: str, stage: str, pipeline_file: Path) -> Closure:
        """All modules of the project that `stage` imports, with their hashes, and the names of installed packages among its imports.

        Raises InputError where the stage has no module, or a module of the project cannot be parsed.
        """
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
        sources = {name: self._source(name, file) for name, file in sorted(seen.items()) if file.name.endswith(".py")}
        data = self._data(seen)
        return Closure(
            modules={name: source.digest for name, source in sources.items()},
            data={name: self.hashes.content(path) for name, path in data.items()},
            external=sorted(external - sys.stdlib_module_names - {""}),
            environment=sorted({name for source in sources.values() for name in source.environment}),
            programs={name: program for source in sources.values() for name, program in source.programs.items()},
            files={f"source:{name}": seen[name] for name in sources}
            | {f"data:{name}": path for name, path in data.items()},
        )

    def find(self, name: str) -> Path | None:
        """The file of a module of the project; a folder without `__init__.py` stands for itself."""
        if name not in self._found:
            self._found[name] = self._find(name)
        return self._found[name]

    def _find(self, name: str) -> Path | None:
        parent, _, last = name.rpartition(".")
        if parent:
            above = self.find(parent)
            bases = (
                []
                if above is None
                else [above.parent]
                if above.name == "__init__.py"
                else [above]
                if above.is_dir()
                else []
            )
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
        if file not in self._read:
            of_folder = Source("", [], Names({}, {}, {}), [], {})
            self._read[file] = (
                of_folder if file.is_dir() else self.hashes.source(file, lambda: self._parse(name, file), Source)
            )
        return self._read[file]

    @staticmethod
    def _parse(name: str, file: Path) -> Source:
        try:
            return source_of(file.read_text(encoding="utf-8"), name, file.name == "__init__.py")
        except SyntaxError as error:
            raise InputError(
                f"not Python: {error.msg}", file=f"{file}:{error.lineno}", cure="mend that line"
            ) from error
        except InputError as error:
            raise InputError(error.found, file=file, key=error.key, cure=error.cure) from error

    def _data(self, modules: dict[str, Path]) -> dict[str, Path]:
        """Whatever is no Python beside the modules, or in folders beside them that are no packages."""
        packages = {
            name.rpartition(".")[0]: file.parent
            for name, file in modules.items()
            if not file.is_dir() and file.name != "__init__.py"
        }
        packages |= {name: file.parent for name, file in modules.items() if file.name == "__init__.py"}
        packages.pop("", None)  # beside a module that is in no package lies anything
        files = {
            f"{name}:{path.relative_to(folder).as_posix()}": path
            for name, folder in packages.items()
            for path in self._data_of(folder)
        }
        return dict(sorted(files.items()))

    def _data_of(self, folder: Path) -> list[Path]:
        if folder not in self._beside:
            self._beside[folder] = _data_files(folder)
        return self._beside[folder]


def _with_parents(name: str) -> list[str]:
    parts = name.split(".")
    return [".".join(parts[: k + 1]) for k in range(len(parts))]


def _data_files(folder: Path) -> list[Path]:
    files = []
    for path in sorted(path for path in folder.iterdir() if not left_over(path.name)):
        if path.is_dir():
            files += _data_files(path) if not (path / "__init__.py").exists() else []
        elif path.is_file() and path.suffix != ".py":
            files.append(path)
    return files
