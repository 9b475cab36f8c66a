"""The source a stage depends on: its module and everything of the project it imports, however far.

Each module is hashed by its syntax tree without comments and docstrings, so that a remark reruns nothing.  Imports are
found anywhere in a module, inside functions too; modules named only at run time (`import_module(name)`) are not seen.
Package data counts by one rule: every file that lies beside an imported module, or in a folder beside it that is no
package, and is not Python, but for what Python and editors leave there (`left_over`).

What else a module's numbers depend on it declares in constants, which are read from its syntax tree:

    ENVIRONMENT = ("FACTORLIB_FUSED",)    environment variables; their values count
    PROGRAMS = {"CC": "cc"}               programs by the variable that names them, and what stands in for it; whether
                                          there is such a program counts, and its name, not where it lies

A stage's parameters and their defaults are read from syntax trees too, for planning must not import what a stage imports.
A default is followed to a base class, a constant of any module, and into an instance made without arguments (`Limits()`).
"""

from __future__ import annotations

import ast
import hashlib
import os
import shlex
import shutil
import sys
from collections import Counter
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import msgspec

from factorlib.errors import InputError, did_you_mean
from factorlib.runner.filehash import FileHashes, left_over, read_cache, write_cache

CODE = ("source:", "data:", "environment:", "program:")  # the fields of a record that a closure makes
DEEPEST = 16  # names that stand for names, structs in structs: one more is not followed


class Names(msgspec.Struct, frozen=True):
    """What the top level of a module defines and takes `from` others.

    classes:  by name, the bases as they are written, and the fields with the text of their defaults
    imported: by name, the module and the name there
    assigned: by name, the text of what is assigned to it, of names that are bound once in the whole module
    """

    classes: dict[str, tuple[list[str], dict[str, str]]]
    imported: dict[str, tuple[str, str]]
    assigned: dict[str, str]


class Source(msgspec.Struct, frozen=True):
    """What one module's text says: a digest of its syntax tree, dotted names as it imports them, what its top level defines,
    and the environment variables and programs that it declares its numbers to depend on."""

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
        programs = {name: _program(name, default) for name, default in self.programs.items()}
        return (
            {f"source:{module}": digest for module, digest in self.modules.items()}
            | {f"data:{file}": digest for file, digest in self.data.items()}
            | {f"environment:{name}": os.environ[name] for name in self.environment if name in os.environ}
            | {f"program:{name}": program for name, program in programs.items() if program}
        )


def _program(name: str, default: str) -> str | None:
    """The words that name a program, without the folder it lies in; None where there is no such program."""
    command = os.environ.get(name, default)
    try:
        words = shlex.split(command) or [""]
    except ValueError as error:
        cure = f"name a program, as in {name}={default}"
        raise InputError(f"{command!r} is no command ({error})", key=name, cure=cure) from None
    return " ".join([Path(words[0]).name, *words[1:]]) if shutil.which(words[0]) else None


# ── one module ───────────────────────────────────────────────────────────────────────────────────────────────────────


def source_of(text: str, module: str, is_package: bool) -> Source:
    """What a module's text says.  Raises SyntaxError, and InputError for a declaration that is none."""
    tree = ast.parse(text)
    imports = sorted({name for node in ast.walk(tree) for name in _imported(node, module, is_package)})
    names, environment = _names_of(tree), _declared(tree, "ENVIRONMENT", list[str], '("A_VARIABLE",)')
    programs = _declared(tree, "PROGRAMS", dict[str, str], '{"CC": "cc"}')
    for node in ast.walk(tree):
        _drop_docstring(node)
    digest = hashlib.sha256(ast.dump(tree).encode()).hexdigest()[:32]
    return Source(digest, imports, names, environment or [], programs or {})


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


def _imported(node: ast.AST, module: str, is_package: bool) -> list[str]:
    if isinstance(node, ast.Import):
        return [alias.name for alias in node.names]
    if isinstance(node, ast.ImportFrom):
        base = node.module or ""
        if node.level:
            parts = module.split(".") if is_package else module.split(".")[:-1]
            base = ".".join([*parts[: len(parts) - node.level + 1], *([base] if base else [])])
        return [base, *(f"{base}.{alias.name}" for alias in node.names)]
    return []


def _drop_docstring(node: ast.AST) -> None:
    """The docstring of a module, class or function, and the strings that follow the fields of a class."""
    documented = ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef
    if isinstance(node, documented) and ast.get_docstring(node, clean=False) is not None:
        node.body = node.body[1:] or [ast.Pass()]
    if isinstance(node, ast.ClassDef):
        values = [(item, getattr(item, "value", None) if isinstance(item, ast.Expr) else None) for item in node.body]
        texts = [item for item, value in values if isinstance(value, ast.Constant) and isinstance(value.value, str)]
        node.body = [item for item in node.body if item not in texts] or [ast.Pass()]


def _names_of(tree: ast.Module) -> Names:
    classes, imported, assigned = {}, {}, {}
    for node in tree.body:
        if isinstance(node, ast.ClassDef):
            fields = [item for item in node.body if isinstance(item, ast.AnnAssign) and hasattr(item.target, "id")]
            defaults = {item.target.id: ast.unparse(item.value) if item.value else "none" for item in fields}
            classes[node.name] = [ast.unparse(base) for base in node.bases], defaults
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            imported |= {alias.asname or alias.name: (node.module, alias.name) for alias in node.names}
        elif isinstance(node, ast.Assign):
            assigned |= {target.id: ast.unparse(value) for target, value in _pairs(node) if hasattr(target, "id")}
    stored = (ast.Store, ast.Del)
    bound = Counter(n.id for n in ast.walk(tree) if isinstance(n, ast.Name) and isinstance(n.ctx, stored))
    return Names(classes, imported, {name: text for name, text in assigned.items() if bound[name] == 1})


def _pairs(node: ast.Assign) -> Iterator[tuple[ast.expr, ast.expr]]:
    """Targets and values that a default may be followed to; A, B = x, y are two assignments."""
    (target, *others), value = node.targets, node.value
    both = isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple) and len(target.elts) == len(value.elts)
    pairs = zip(target.elts, value.elts) if both and not others else ((each, value) for each in node.targets)
    for target, value in pairs:
        made = isinstance(value, ast.Call) and not value.args and not value.keywords
        if made or isinstance(value, ast.Constant | ast.Tuple | ast.UnaryOp | ast.Name):
            yield target, value


# ── all modules ──────────────────────────────────────────────────────────────────────────────────────────────────────


class Unknown(str):
    """The text of a default that no syntax tree tells the value of: it equals no value that a parameter may have."""


class Sources:
    """The modules below some root folders, read through a cache of file hashes."""

    def __init__(self, roots: list[Path], hashes: FileHashes):
        self.roots, self.hashes = list(dict.fromkeys(roots)), hashes
        self._places: dict[str, Path | None] = {}
        self._read: dict[Path, Source] = {}  # each file is looked at once, however many stages import it
        self._beside: dict[Path, list[Path]] = {}  # data files by folder

    def closure(self, package: str, stage: str, pipeline_file: Path) -> Closure:
        """All modules of the project that `stage` imports, with their hashes, and the installed packages among its imports.

        Raises InputError where the stage has no module, or a module of the project cannot be parsed.
        """
        self._check_stage(package, stage, pipeline_file)
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
        data = self._data(places)
        return Closure(
            modules={name: source.digest for name, source in sources.items()},
            data={name: self.hashes.content(path) for name, path in data.items()},
            external=sorted(external - sys.stdlib_module_names - {""}),
            environment=sorted({name for source in sources.values() for name in source.environment}),
            programs={name: program for source in sources.values() for name, program in source.programs.items()},
            files={f"source:{name}": places[name] for name in sources} | {f"data:{name}": data[name] for name in data},
        )

    def find(self, name: str) -> Path | None:
        """The file of a module of the project; a folder without `__init__.py` stands for itself."""
        if name not in self._places:
            parent, _, last = name.rpartition(".")
            above = self.find(parent) if parent else None
            of_package = above is not None and above.name == "__init__.py"
            bases = [above.parent if of_package else above] if above else [] if parent else self.roots
            self._places[name] = next((file for base in bases if (file := _module_in(base, last))), None)
        return self._places[name]

    def _check_stage(self, package: str, stage: str, pipeline_file: Path) -> None:
        if self.find(f"{package}.{stage}") is None:
            known = [p.stem for p in (self.roots[0] / package).glob("*.py") if p.stem != "__init__"]
            words, cure = f"the stage {stage!r} has no module {package}/{stage}.py", did_you_mean(stage, known)
            raise InputError(words, file=pipeline_file, key=f"stages.{stage}", cure=cure)

    def _source(self, name: str, file: Path) -> Source:
        if file not in self._read:
            of_folder, parse = Source("", [], Names({}, {}, {}), [], {}), partial(self._parse, name, file)
            self._read[file] = of_folder if file.is_dir() else self.hashes.remembered("source", file, parse, Source)
        return self._read[file]

    @staticmethod
    def _parse(name: str, file: Path) -> Source:
        try:
            return source_of(file.read_text(encoding="utf-8"), name, file.name == "__init__.py")
        except SyntaxError as error:
            where = f"{file}:{error.lineno}"
            raise InputError(f"not Python: {error.msg}", file=where, cure="mend that line") from error
        except InputError as error:
            raise InputError(error.found, file=file, key=error.key, cure=error.cure) from error

    def _data(self, modules: dict[str, Path]) -> dict[str, Path]:
        """Whatever is no Python beside the modules, or in folders beside them that are no packages."""
        packages = {
            name if file.name == "__init__.py" else name.rpartition(".")[0]: file.parent
            for name, file in modules.items()
            if not file.is_dir()
        }
        packages.pop("", None)  # beside a module that is in no package lies anything
        for folder in packages.values():
            if folder not in self._beside:
                self._beside[folder] = list(_data_files(folder))
        files = {f"{n}:{p.relative_to(f).as_posix()}": p for n, f in packages.items() for p in self._beside[f]}
        return dict(sorted(files.items()))

    # ── parameters ───────────────────────────────────────────────────────────────────────────────────────────────────

    def stage_params(self, package: str, stage: str, pipeline_file: Path) -> dict[str, Any]:
        """A stage's parameters and their defaults as YAML would have them (a struct is a table), read without importing it.

        A default is `Unknown` where the source does not tell it for certain.
        """
        self._check_stage(package, stage, pipeline_file)
        return self._fields(f"{package}.{stage}", "Params", 0)

    def _names(self, module: str) -> Names | None:
        file = self.find(module)
        return self._source(module, file).names if file else None

    def _fields(self, module: str, name: str, deep: int) -> dict[str, Any]:
        """Fields of a class with their defaults, those of its bases first; nothing of a class outside the project."""
        names = self._names(module)
        if names is None or deep > DEEPEST:
            return {}
        if name not in names.classes:
            return self._fields(*names.imported[name], deep + 1) if name in names.imported else {}
        bases, defaults = names.classes[name]
        fields: dict[str, Any] = {}
        for base in reversed(bases):  # the first of two bases decides
            fields |= self._fields(module, base, deep + 1)
        return fields | {field: self._value(text, module, deep) for field, text in defaults.items()}

    def _value(self, text: str, module: str, deep: int) -> Any:
        names, (of, _, attribute) = self._names(module), text.partition(".")
        if names is None or deep > DEEPEST:
            return Unknown(text)
        if text.endswith("()"):
            return self._fields(module, text.removesuffix("()"), deep + 1) or Unknown(text)
        if text in names.assigned:
            return self._value(names.assigned[text], module, deep + 1)
        if text in names.imported:
            source, name = names.imported[text]
            return self._value(name, source, deep + 1)
        if attribute and of in {*names.assigned, *names.imported}:
            struct = self._value(of, module, deep + 1)
            return struct.get(attribute, Unknown(text)) if isinstance(struct, dict) else Unknown(text)
        try:
            return _listed(ast.literal_eval(text))
        except (ValueError, SyntaxError):
            return Unknown(text)


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


def _listed(value: Any) -> Any:
    return [_listed(item) for item in value] if isinstance(value, tuple | list) else value


def other_than(defaults: dict[str, Any], values: dict[str, Any]) -> dict[str, Any]:
    """The parameters that are not what they would be without being set; of a table those of its fields.

    >>> other_than({"lobes": 72, "gain": 0.5, "limits": {"faces": 9}}, {"lobes": 72, "gain": 0.25, "limits": {"faces": 9}})
    {'gain': 0.25}
    >>> other_than({"lobes": 72, "gain": 1.0, "size": Unknown("3")}, {"lobes": 72.0, "gain": 1, "size": "3"})
    {'lobes': 72.0, 'size': '3'}
    """
    others = {}
    for name, value in values.items():
        default = defaults.get(name, Unknown())
        if isinstance(value, dict) and isinstance(default, dict):
            value = other_than(default, value)
            others |= {name: value} if value else {}
        elif not _same(value, default):
            others[name] = value
    return others


def recorded(default: Any) -> Any:
    """A default as a key's record has it: what is unknown is told from a text that is known.

    >>> recorded({"size": Unknown("3"), "name": "3"})
    {'size': {'text': '3'}, 'name': '3'}
    """
    if isinstance(default, dict):
        return {name: recorded(value) for name, value in default.items()}
    return {"text": str(default)} if isinstance(default, Unknown) else default


def _same(value: Any, default: Any) -> bool:
    """Whether they are one value to a field with that default: a whole number will do for any number, 1 is not true, -0.0 not 0.0."""
    if isinstance(value, list) and isinstance(default, list):
        return len(value) == len(default) and all(map(_same, value, default))
    if type(default) is float and type(value) is int:
        value = float(value) if abs(value) < 1 << 53 else value
    return type(value) is type(default) and repr(value) == repr(default)


class Packages:
    """Versions of the installed packages that are imported, looked up once per state of site-packages."""

    def __init__(self, cache: Path):
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
            write_cache(self.cache, (self.state, self.known))
        return {name: version for each in imports for name, version in self.known[each].items()}
