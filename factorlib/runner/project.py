"""A project: pipeline.yaml as types, where everything lies, its datasets and recipes by name or path."""

from __future__ import annotations

import importlib
import json
import os
import re
import shlex
import signal
import threading
from collections.abc import Callable, Sequence
from functools import cache, partial
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, NoReturn

import msgspec

from factorlib.errors import InputError, did_you_mean
from factorlib.yamlfile import convert, parse_yaml, read_yaml

HOW = "name a folder in data/, or give a path to one with a dataset.yaml in it"
PIPELINE = "pipeline.yaml"
LIBRARY = Path(__file__).resolve().parent.parent.parent  # the folder that holds factorlib/
RESERVED = ("studies", "bench", "store", "compare", "docs")  # folders of build/ that are no datasets
LONGEST = 255  # bytes of a name, on every common file system
SHARED = "FACTORLIB_STORE"  # environment variable: the folder of a store that several checkouts share
ALL = "all"  # recipes


class Recipe(msgspec.Struct, frozen=True):
    """Content of a recipe.

    facts: JSON-able, by field;  files: those it names, as they are written there -> absolute path
    """

    facts: dict[str, Any]
    files: dict[str, Path]


class Data(msgspec.Struct, frozen=True):
    """Dataset as the runner sees it: its folder, its photos, a slice of it by name and photo, and its faults.

    slice: has `facts`, JSON-able; `fields`, the same by their names in the dataset's file; and `files` that they name
    recipe: reads a recipe for this data set; InputError where it asks for what is not there
    faults: of the files that a slice names, as far as looking at headers tells, by the parameters of the stage that
            takes it and the file in which these stand
    recipe_faults: of the files that a recipe names;  cautions: what will run, but leave the answer open, as sentences
    """

    folder: Path
    photos: list[str]
    slice: Callable[[str, str | None], Any]
    faults: Callable[[str, str | None, dict[str, Any], Path], list[InputError]] = lambda *_: []
    recipe: Callable[[Path], Recipe] | None = None
    recipe_faults: Callable[[dict[str, Path]], list[InputError]] = lambda _: []
    cautions: Callable[[], list[str]] = list


class Provider(NamedTuple):
    """Reader of datasets, and the names of their slices."""

    slices: tuple[str, ...]
    read: Callable[[Path], Data]


def take_sigterm_back() -> None:
    """Let Python handle SIGTERM again: pycolmap, once imported, prints a C stack instead."""
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGTERM))


def photo_sets() -> Provider:
    """Return the provider of the project's own datasets."""
    from factorlib.dataset.read import read_dataset
    from factorlib.dataset.slices import SLICES, dataset_slice

    def read(path: Path) -> Data:
        """Return the data set of a folder, as the runner sees it."""
        dataset = read_dataset(path)
        take_sigterm_back()

        def recipe(file: Path) -> Recipe:
            """Read a recipe when one is asked for."""
            from factorlib.recipe.read import files_of, read_recipe

            read = read_recipe(file, dataset)
            return Recipe(msgspec.to_builtins(read), files_of(read, file))

        @cache
        def look() -> Any:
            """`factorlib.validation`, by its name as stages are, when it is first asked for: it imports science."""
            return importlib.import_module("factorlib.validation").Validation(dataset)

        photos, faults = [photo.name for photo in dataset.spec.photos], lambda *of: look().faults(*of)
        slice_, recipe_faults = partial(dataset_slice, dataset), lambda files: look().recipe_faults(files)
        return Data(dataset.folder, photos, slice_, faults, recipe, recipe_faults, lambda: look().cautions())

    return Provider(SLICES, read)


class Project(msgspec.Struct, frozen=True):
    """A checkout: pipeline.yaml, the package of its stages, data/ and build/.

    shipped: the folder of the first two and of recipes, where the installed package brings them and `root` is any
             folder
    """

    root: Path
    provider: Provider
    package: str = "stages"
    shipped: Path | None = None

    @property
    def code_root(self) -> Path:
        """Return the folder of pipeline.yaml and of the package of its stages."""
        return self.shipped or self.root

    @property
    def pipeline_file(self) -> Path:
        """Return the file that declares the stages."""
        return self.code_root / PIPELINE

    @property
    def build(self) -> Path:
        """Return the folder of all results."""
        return self.root / "build"

    @property
    def store(self) -> Path:
        """Return the folder of the store: in `build`, or FACTORLIB_STORE.  InputError where there is none."""
        if not (named := os.environ.get(SHARED)):
            return self.build / "store"
        folder = Path(named).expanduser()
        if os.path.lexists(folder) and not os.path.isdir(folder):
            cure = "name a folder instead; it may be empty"
            raise InputError("is a file, where a folder is expected", file=named[:100], key=SHARED, cure=cure)
        if not os.path.isdir(folder):
            cure = f"make it (mkdir -p {shlex.quote(named[:100])}), or name another folder that you may write to"
            raise InputError("there is no such folder", file=named[:100], key=SHARED, cure=cure)
        return folder.resolve()

    def command(self, verb: str, dataset: str) -> str:
        """Format a verb for a data set as a user of the checkout, or of the installed package, types it."""
        words = f"factorlib {verb} -d" if self.shipped else f"make {verb} DATASET="
        return f"{words}{' ' * bool(self.shipped)}{shlex.quote(dataset)}"

    def shown(self, path: Path) -> str:
        """Format a path for messages: from where the user stands, if it lies below."""
        here = Path.cwd()
        return str(path.relative_to(here)) if path.is_relative_to(here) else str(path)

    def dataset_folder(self, name: str) -> Path:
        """Find a dataset by its name in data/, or by its path; InputError where it is not there."""
        if (folder := self.find_dataset(name)) is not None:
            return folder
        known = [p.parent.name for p in (self.root / "data").glob("*/dataset.yaml")]
        cure = did_you_mean(name, known) if known and "/" not in name else HOW
        raise InputError(f"there is no dataset {name!r}", key="DATASET", cure=cure)

    def find_dataset(self, name: str) -> Path | None:
        """Find a dataset as `dataset_folder` does.

        Returns None where it is not there.  Raises InputError for what cannot be a dataset's name or path.
        """
        by_name = "/" not in name or name.rstrip("/") in ("", ".", "..")
        if by_name:
            check_name(name, "a dataset", key="DATASET", reserved=RESERVED)
        for path in ([self.root / "data" / name] if by_name else []) + [Path(os.path.abspath(name))]:
            if not os.path.exists(path):
                continue
            folder = path if os.path.isdir(path) else path.parent
            check_name(folder.name, "a dataset", file=folder, key="DATASET", reserved=RESERVED)
            if self.root.is_relative_to(folder) or folder == self.build:
                words = "a dataset cannot be the folder that holds the project"
                raise InputError(words, file=folder, key="DATASET", cure=HOW)
            return folder
        return None

    def recipes(self, data: Data, words: list[str]) -> dict[str, Recipe]:
        """Read the recipes that words name, by name.

        Each word is a path, a name in recipes/ or recipes/<dataset>/, or `all` of these.
        Raises InputError where one is not there, is not good, or two are called the same.
        """
        roots = [root / "recipes" for root in dict.fromkeys([self.code_root, self.root])]
        folders = [*roots, *(root / data.folder.name for root in roots)]  # the latter go before
        known = {path.stem: path for folder in folders for path in sorted(folder.glob("*.yaml"))}
        paths: list[Path] = []
        recipes: dict[str, Recipe] = {}
        for word in words:
            path = Path(os.path.abspath(word))
            if word != ALL and word not in known and not path.is_file():
                by_path = "/" in word or path.suffix
                said = "there is no such recipe" if by_path else f"there is no recipe {word!r}"
                cure = did_you_mean(path.stem if by_path else word, [*known, ALL])
                raise InputError(said, file=word if by_path else None, key="RECIPE", cure=cure)
            paths += known.values() if word == ALL else [known.get(word, path)]
        for path in dict.fromkeys(paths):
            name = check_name(path.stem, "a recipe", file=path, key="RECIPE", most=200)
            if name in recipes:
                said = f"two recipes are called {name!r}: their pictures would lie in one folder"
                raise InputError(said, file=path, cure="rename one of them")
            if data.recipe is None:
                raise InputError("there are no recipes of such a dataset", key="RECIPE", cure="leave RECIPE out")
            recipes[name] = data.recipe(path)
        if not recipes and ALL in words:
            raise InputError("there is none in recipes/", key="RECIPE", cure="name a file: RECIPE=<path>.yaml")
        return recipes


def check_name(
    name: str, kind: str, *, file: Any = None, key: str | None = None, reserved: Sequence[str] = (), most: int = LONGEST
) -> str:
    """`name`, where it can be the name of one file or folder and is not taken; InputError otherwise.

    kind: of what it is the name, with its article;  most: bytes that it may have
    """
    good = name.encode(errors="replace").decode() == name and not set("/\0\n") & set(name)
    if not good or name in ("", ".", "..", *reserved) or len(name.encode()) > most:
        but = f", nor {', '.join(reserved)}" if reserved else ""
        cure = f"give it another name: UTF-8 of at most {most} bytes, without a slash or an end of a line{but}"
        raise InputError(f"{kind} cannot be called {name!r}", file=file, key=key, cure=cure)
    return name


class Code(msgspec.Struct, frozen=True):
    """Name of a stage, where its module is found, its parameters (and their file), and its share of the machine.

    threads: of its libraries' numerics;  cores: the most that independent work is spread over
    """

    root: Path
    package: str
    stage: str
    params: dict[str, Any]
    settings: Path
    threads: int = 1
    cores: int = 1


# ── pipeline.yaml ────────────────────────────────────────────────────────────────────────────────────────────────────

FORMAT = 1
MOST_CORES = 1024
SHOWN = 80  # characters of a setting that messages repeat
LONGEST_SETTING, DEEPEST = 5000, 16  # characters of a setting, parts of its name: a path may have 4096
NAME = re.compile("[a-z][a-z0-9_]*")
TAKEN = ("errors",)  # a folder beside the links that are called as the stages
EXECUTORS = "write processes, or the address of a Dask scheduler, as tcp://10.0.0.1:8786"
WHERE = r"^(processes|(tcp|tls|ws|wss|ucx|ucxx)://[^\s/]+:\d+)$"
Executor = Annotated[str, msgspec.Meta(pattern=WHERE, description=EXECUTORS)]
DATASET = "dataset."  # prefix of the inputs that are slices of the dataset


class Shipping(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """folder: of the package, where the result lies;  made_by: the modules that its content follows from."""

    folder: str
    made_by: list[str]


class Stage(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One stage.

    inputs:  names of stages, or `dataset.<slice>`
    over:    `photo` for a step per photo, `recipe` for one per recipe that is asked for; otherwise one step for the
             whole set
    gather:  in a stage over photos, the file that every `<photo>.json` is gathered into
    makes:   files each step must write, `{photo}` standing for the photo's name; glob patterns
    threads: threads of its libraries' numerics, part of what is computed (a sum depends on them), never the machine's
    cores:   that it spreads independent work over by `Inputs.map`, `all` for those of the machine: they change no bit
             and no key
    logs:    hand it the log of the steps above it (not part of its key)
    when:    a slice of the set: where that says nothing, the stage is not there, and none takes its results
    optional: run it only where it is asked for, or something that is asked for takes its results
    given:   parameters that name a folder outside the dataset, and the files of it that the stage reads; the stage is
             handed the folder among its inputs, and the key has the files' contents, not where they lie
    shipped: the stage's result that comes with the source, taken where it was made by the same modules and parameters
    """

    inputs: list[str] = []
    over: Literal["photo", "recipe"] | None = None
    gather: str | None = None
    makes: list[str] = []
    threads: Annotated[int, msgspec.Meta(ge=1, le=64)] = 1
    cores: Annotated[int, msgspec.Meta(ge=1, le=MOST_CORES)] | Literal["all"] = 1
    logs: bool = False
    when: str | None = None
    optional: bool = False
    given: dict[str, list[str]] = {}
    shipped: Shipping | None = None
    params: dict[str, Any] = {}

    @property
    def slices(self) -> list[str]:
        """Names of the slices of dataset.yaml that the stage takes."""
        return [name.removeprefix(DATASET) for name in self.inputs if name.startswith(DATASET)]

    @property
    def upstream(self) -> list[str]:
        """Names of the stages whose results the stage takes."""
        return [name for name in self.inputs if not name.startswith(DATASET)]

    @property
    def values(self) -> dict[str, Any]:
        """Return the parameters that the stage itself takes."""
        return {name: value for name, value in self.params.items() if name not in self.given}

    @property
    def folders(self) -> dict[str, Path]:
        """Return the folders that parameters name, from the user's folder; links are followed now, as results move."""
        named = {name: str(self.params[name]) for name in self.given if self.params.get(name) is not None}
        return {name: Path(os.path.realpath(folder.replace("\0", ""))) for name, folder in named.items()}


class Pipeline(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Content of pipeline.yaml.

    executor: where steps run, which changes no bit and no key: `processes` of this machine, or the address of a Dask
              scheduler
    """

    format: int
    stages: dict[str, Stage]
    executor: Executor = "processes"

    def order(self) -> list[str]:
        """Stages, each after what it takes; otherwise as they stand in the file."""
        return list(TopologicalSorter({name: stage.upstream for name, stage in self.stages.items()}).static_order())

    def for_data(self, says_nothing: Callable[[str], bool]) -> Pipeline:
        """Return the stages that a data set has, by which slices of it say nothing (`Stage.when`)."""
        gone = {name for name, stage in self.stages.items() if stage.when and says_nothing(stage.when)}
        kept = {name: stage for name, stage in self.stages.items() if name not in gone}
        for name, stage in kept.items():
            kept[name] = msgspec.structs.replace(stage, inputs=[each for each in stage.inputs if each not in gone])
        return msgspec.structs.replace(self, stages=kept)

    def needed(self, targets: list[str] | None) -> list[str]:
        """Return the targets and everything above them, in order.

        None stands for all stages but the optional ones that none of them takes.
        """
        usual = [name for name, stage in self.stages.items() if not stage.optional]
        wanted, order = set(usual if targets is None else targets), self.order()
        for name in reversed(order):
            if name in wanted:
                wanted.update(self.stages[name].upstream)
        return [name for name in order if name in wanted]


def read_pipeline(path: Path, known_slices: tuple[str, ...]) -> Pipeline:
    """Read and check pipeline.yaml; `known_slices` are the slices that a data set can give.

    Raises InputError for another format, an unknown name, or stages that need each other.
    """
    pipeline = read_yaml(path, Pipeline)

    def refuse(words: str, key: str, cure: str) -> NoReturn:
        raise InputError(words, file=path, key=key, cure=cure) from None

    if pipeline.format != FORMAT:
        refuse(f"format {pipeline.format} is not known", "format", f"this version reads format: {FORMAT}")
    known = [*(DATASET + name for name in known_slices), *pipeline.stages]
    for name, stage in pipeline.stages.items():
        key = f"stages.{name}"
        if not NAME.fullmatch(name) or name in TAKEN:
            refuse(f"a stage cannot be called {name!r}", "stages", "give it another name, of a-z, 0-9 and _")
        if stage.gather is not None:
            check_name(stage.gather, "a gathered file", file=path, key=f"{key}.gather")
            if stage.over != "photo":
                refuse("only what is made per photo can be gathered", f"{key}.gather", "add over: photo")
        for entry in (entry for entry in stage.inputs if entry not in known):
            refuse(f"there is no {entry!r}", f"{key}.inputs", did_you_mean(entry, known))
        if stage.when is not None and stage.when not in known_slices:
            refuse(f"there is no slice {stage.when!r}", f"{key}.when", did_you_mean(stage.when, known_slices))
        for param in (param for param in stage.given if param in stage.inputs):
            refuse(f"{param!r} is a stage already", f"{key}.given", "call the parameter something else")
    try:
        pipeline.order()
    except CycleError as error:
        words = f"stages that need each other: {' <- '.join(error.args[1])}"
        refuse(words, "stages", "make the second pass a stage of its own")
    return pipeline


def with_settings(pipeline: Pipeline, settings: list[str]) -> Pipeline:
    """Replace values of the pipeline by words `stage.parameter=value` and `executor=…`; blanks separate several words.

    >>> with_settings(Pipeline(1, {"solve": Stage()}), ["solve.lobes=64 solve.tolerance=1e-3"]).stages["solve"].params
    {'lobes': 64, 'tolerance': 0.001}
    """
    stages, executor = dict(pipeline.stages), pipeline.executor
    for word in _words(settings):
        target, equals, text = word.partition("=")
        if target == "executor":
            executor = convert(text, Executor, f"SET {_cut(word)}")
            continue
        stage, *keys = target.split(".")
        if not equals or not keys or not all(keys) or len(keys) > DEEPEST or len(word) > LONGEST_SETTING:
            cure = 'write stage.parameter=value, as in SET="solve.cells=800"'
            raise InputError(f"{_cut(word)!r} is no setting", key="SET", cure=cure)
        if stage not in stages:
            raise InputError(f"there is no stage {stage!r}", key=f"SET {_cut(word)}", cure=did_you_mean(stage, stages))
        try:
            value = parse_yaml(text, f"SET {_cut(word)}")
            json.dumps(value, allow_nan=False), msgspec.msgpack.encode(value)
        except (ValueError, OverflowError, RecursionError) as error:
            if isinstance(error, InputError):
                raise
            words, cure = f"no key can hold the value ({error})", "write a finite number, a word, or a short list"
            raise InputError(words, key=f"SET {_cut(word)}", cure=cure) from error
        table = params = dict(stages[stage].params)
        for name in keys[:-1]:
            inner = table.get(name)
            table[name] = table = dict(inner) if isinstance(inner, dict) else {}
        table[keys[-1]] = value
        stages[stage] = msgspec.structs.replace(stages[stage], params=params)
    return msgspec.structs.replace(pipeline, stages=stages, executor=executor)


def said_of_settings(error: InputError, settings: list[str]) -> InputError:
    """Return the error as one of the setting, where it is about one, not of the file whose value that replaces."""
    for word in reversed(_words(settings)):
        stage, _, keys = word.partition("=")[0].partition(".")
        key = f"stages.{stage}.params.{keys}"
        if error.key == key or (error.key or "").startswith((f"{key}.", f"{key}[")):
            return InputError(error.found, key=f"SET {_cut(word)}", cure=error.cure)
    return error


def _words(settings: list[str]) -> list[str]:
    words = []
    for text in settings:
        try:
            words += shlex.split(text)
        except ValueError as error:
            said = f"{_cut(text)!r} cannot be split into words ({error})"
            raise InputError(said, key="SET", cure="close every quote") from error
    return words


def _cut(word: str) -> str:
    return word if len(word) <= SHOWN else word[:SHOWN] + "…"
