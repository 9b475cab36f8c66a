"""A project: pipeline.yaml as types, its folders, and its datasets and recipes by name or path."""

from __future__ import annotations

import importlib
import logging
import os
import shlex
import signal
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import cache, partial
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, NoReturn

import msgspec

from factorlib.errors import InputError, did_you_mean
from factorlib.jsonfile import json_text
from factorlib.reading import one_line
from factorlib.yamlfile import convert, parse_yaml, read_yaml

DATASET_CURE = "name a folder in data/, or give the path of a folder with a dataset.yaml"
PIPELINE = "pipeline.yaml"
LIBRARY = Path(__file__).resolve().parent.parent.parent  # the folder that holds factorlib/
RESERVED = ("studies", "bench", "store", "compare", "docs")  # folders of build/ that are not datasets
log = logging.getLogger("factorlib.runner")
LONGEST = 200  # bytes of the name of a dataset or recipe
SHARED = "FACTORLIB_STORE"  # environment variable: folder of a store that several checkouts share
ALL = "all"  # stands for all recipes


class Recipe(msgspec.Struct, frozen=True):
    """Content of a recipe.

    facts: JSON-able, by field;  files: absolute path by the name that the recipe gives
    """

    facts: dict[str, Any]
    files: dict[str, Path]


class Data(msgspec.Struct, frozen=True):
    """Dataset as the runner sees it: its folder, its photos, its slices by name and photo, and its faults.

    slice:  has `facts`, JSON-able; `fields`, the facts by their names in the dataset's file; and `files`, their names
    faults: those of the files of slices; a request is a slice, a photo or None, the parameters of the stage that takes
            the slice, and the file in which these stand
    recipe: reads a recipe for this dataset; InputError if the recipe asks for what the dataset does not have
    recipe_faults: those of a recipe's files
    cautions: sentences about what runs, but leaves the answer ambiguous
    """

    folder: Path
    photos: list[str]
    slice: Callable[[str, str | None], Any]
    faults: Callable[[list[tuple[str, str | None, dict[str, Any], Path]]], list[InputError]] = lambda _: []
    recipe: Callable[[Path], Recipe] = lambda _: Recipe({}, {})
    recipe_faults: Callable[[dict[str, Path]], list[InputError]] = lambda _: []
    cautions: Callable[[], list[str]] = list


class Provider(NamedTuple):
    """Reader of datasets for the runner.

    slices: names of the slices that a dataset has
    read:   function of a dataset's folder, and of names of further photos to hold out
    """

    slices: tuple[str, ...]
    read: Callable[[Path, Sequence[str]], Data]


def restore_sigterm() -> None:
    """Restore Python's handler of SIGTERM, which importing pycolmap replaces by one that prints a C stack."""
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGTERM))


def photo_sets() -> Provider:
    """Return the reader of datasets with a dataset.yaml."""
    from factorlib.dataset.read_dataset import hold_out, read_dataset
    from factorlib.dataset.slices import SLICES, dataset_slice

    def read(path: Path, held_out: Sequence[str] = ()) -> Data:
        """Read the dataset of a folder and hold out further photos."""
        dataset = hold_out(read_dataset(path), held_out)
        restore_sigterm()

        def recipe(file: Path) -> Recipe:
            """Read a recipe."""
            from factorlib.recipe.read_recipe import files_of, read_recipe

            content = read_recipe(file, dataset)
            return Recipe(msgspec.to_builtins(content), files_of(content, file))

        @cache
        def validation() -> Any:
            """Return the validation of the dataset; its module is loaded by name, as stages are, for it is science."""
            module = importlib.import_module("factorlib.validation")
            restore_sigterm()
            return module.Validation(dataset)

        return Data(
            dataset.folder,
            [photo.name for photo in dataset.spec.photos],
            partial(dataset_slice, dataset),
            lambda requests: validation().faults(requests),
            recipe,
            lambda files: validation().recipe_faults(files),
            lambda: validation().cautions(),
        )

    return Provider(SLICES, read)


class Project(msgspec.Struct, frozen=True):
    """A checkout: pipeline.yaml, the package of its stages, data/ and build/."""

    root: Path
    provider: Provider
    package: str = "stages"

    @property
    def pipeline_file(self) -> Path:
        """File that declares the stages."""
        return self.root / PIPELINE

    @property
    def build(self) -> Path:
        """Folder of all results."""
        return self.root / "build"

    @property
    def store(self) -> Path:
        """Folder of the store: in `build`, or FACTORLIB_STORE; InputError if that is not a folder."""
        if not (name := os.environ.get(SHARED)):
            return self.build / "store"
        if not (folder := Path(name).expanduser()).is_dir():
            cure = f"create it (mkdir -p {shlex.quote(name)}), or name another folder; it may be empty"
            raise InputError("there is no such folder", file=name, key=SHARED, cure=cure)
        return folder.resolve()

    def command(self, verb: str, dataset: str) -> str:
        """Format the command of a verb for a dataset."""
        return f"make {verb} DATASET={shlex.quote(dataset)}"

    def short_path(self, path: Path) -> str:
        """Format a path for messages: relative to the current folder if it lies below."""
        cwd = Path.cwd()
        return str(path.relative_to(cwd)) if path.is_relative_to(cwd) else str(path)

    def dataset_folder(self, name: str) -> Path:
        """Return the folder of a dataset by its name in data/ or its path; InputError if there is none."""
        if (folder := self.find_dataset(name)) is not None:
            return folder
        known = [p.parent.name for p in (self.root / "data").glob("*/dataset.yaml")]
        cure = did_you_mean(name, known) if known and "/" not in name else DATASET_CURE
        raise InputError(f"there is no dataset {name!r}", key="DATASET", cure=cure)

    def find_dataset(self, name: str) -> Path | None:
        """Return the folder of a dataset, None if there is none; InputError for an impossible name or path.

        A name is that of a folder in data/, of one here, or of results, which name the folder of their dataset.
        """
        paths = [Path(os.path.abspath(name))]
        if "/" not in name or name.rstrip("/") in ("", ".", ".."):
            check_name(name, "a dataset", key="DATASET", reserved=RESERVED)
            paths.insert(0, self.root / "data" / name)
            with suppress(OSError):  # build/<name>/dataset.txt
                paths.append(self.root / os.fsdecode((self.build / name / "dataset.txt").read_bytes().strip() or name))
        for path in paths:
            if os.path.exists(path):
                folder = path if os.path.isdir(path) else path.parent
                check_name(folder.name, "a dataset", file=folder, key="DATASET", reserved=RESERVED)
                if self.root.is_relative_to(folder) or folder == self.build:
                    fault = "a dataset cannot be the folder that holds the project"
                    raise InputError(fault, file=folder, key="DATASET", cure=DATASET_CURE)
                return folder
        return None

    def recipes(self, data: Data, words: Sequence[str]) -> dict[str, Recipe]:
        """Read the recipes that `words` name; return them by name.

        Each word is a path, a name in recipes/ or recipes/<dataset>/, or `all` of these.  `all` leaves out, with a
        warning, those of recipes/, which are for every dataset, that do not suit this one.

        Raises:
            InputError: A recipe does not exist or is wrong, or two have one name.
        """
        shared = self.root / "recipes"
        folders = [shared, shared / data.folder.name]  # The dataset's own take precedence.
        known = {path.stem: path for folder in folders for path in sorted(folder.glob("*.yaml"))}
        paths: list[Path] = []
        for word in words:
            path = known.get(word, Path(os.path.abspath(word)))
            if word != ALL and not path.is_file():
                cure = did_you_mean(path.stem, [*known, ALL])
                raise InputError(f"there is no recipe {word!r}", key="RECIPE", cure=cure)
            paths += known.values() if word == ALL else [path]
        recipes: dict[str, Recipe] = {}
        for path in dict.fromkeys(paths):
            check_name(path.stem, "a recipe", file=path, key="RECIPE")
            if path.stem in recipes:
                fault = f"two recipes are called {path.stem!r}; their pictures would go to one folder"
                raise InputError(fault, file=path, cure="rename one of them")
            try:
                recipes[path.stem] = data.recipe(path)
            except InputError as error:
                if ALL not in words or path.parent != shared:
                    raise
                log.warning("RECIPE=all leaves out %s: %s", path.stem, error)
        return recipes


def check_name(name: str, kind: str, *, file: Any = None, key: str | None = None, reserved: Sequence[str] = ()) -> None:
    """Raise InputError for a name that a folder of results cannot have, or a reserved one.

    kind: what the name is of, with its article, for the message
    """
    usable = name.isprintable() and "/" not in name and len(name.encode()) <= LONGEST
    if not usable or name in ("", ".", "..", *reserved):
        reserved_names = f"; the names {', '.join(reserved)} are reserved" if reserved else ""
        cure = f"rename it: printable characters, at most {LONGEST} bytes, no slash{reserved_names}"
        raise InputError(f"{kind} cannot be called {name!r}", file=file, key=key, cure=cure)


class StageCode(msgspec.Struct, frozen=True):
    """Module of a stage, its parameters and their file, and its processors.

    root:     folder that holds the package of stages
    package:  name of that package
    stage:    name of the module in it
    params:   parameters by name
    settings: file that sets them, for messages
    threads:  threads of its numerical libraries
    cores:    greatest number of cores for independent work
    """

    root: Path
    package: str
    stage: str
    params: dict[str, Any]
    settings: Path
    threads: int = 1
    cores: int = 1


# ── pipeline.yaml ────────────────────────────────────────────────────────────────────────────────────────────────────

StageName = Annotated[str, msgspec.Meta(pattern="^[a-z][a-z0-9_]*$", description="rename it: a-z, 0-9 and _")]
MOST_CORES = 1024
DEEPEST = 16  # parts of the name of a setting
EXECUTORS = "write processes, or the address of a Dask scheduler, such as tcp://10.0.0.1:8786"
EXECUTOR_PATTERN = r"^(processes|(tcp|tls|ws|wss|ucx|ucxx)://[^\s/]+:\d+)$"
Executor = Annotated[str, msgspec.Meta(pattern=EXECUTOR_PATTERN, description=EXECUTORS)]
DATASET = "dataset."  # prefix of the inputs that are slices of the dataset


class Shipping(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Location and origin of a result that ships with the source.

    folder:  folder of the result, relative to the root of the source
    made_by: modules that determine its content
    """

    folder: str
    made_by: list[str]


class Stage(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A stage as pipeline.yaml declares it.

    inputs:  names of stages, or `dataset.<slice>`
    over:    `photo` for a step per photo, `recipe` for one per requested recipe; otherwise one step for the whole set
    gather:  in a stage over photos, the file that every `<photo>.json` is gathered into
    makes:   files that each step must write, `{photo}` standing for the photo's name; glob patterns
    threads: threads of its libraries' numerics; part of the key, because a sum depends on them
    cores:   most cores for independent work by `Inputs.map`, or `all`; they change no bit and no key
    logs:    pass the log of the steps above it (not part of its key)
    when:    a slice of the set; without content there, the stage does not exist, and no stage takes its results
    optional: run it only on request, or for a requested stage that takes its results
    given:   parameters that name a folder outside the dataset, and the files of it that the stage reads; the folder is
             one of the inputs, and the key has the files' contents, not their location
    shipped: result that ships with the source, copied if it was made by the same modules and parameters
    presets: parameters by the name of a preset, which the setting `<stage>.preset=<name>` stands for
    params_of: stages whose parameters it takes, each under that stage's name
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
    presets: dict[str, dict[str, Any]] = {}
    params_of: list[str] = []

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
        """Parameters of the stage's `Params`: all but those that name a folder."""
        return {name: value for name, value in self.params.items() if name not in self.given}

    @property
    def folders(self) -> dict[str, Path]:
        """Folders that parameters name, with links followed, since links to results move."""
        named = {name: str(self.params[name]) for name in self.given if self.params.get(name) is not None}
        return {name: Path(os.path.realpath(folder.replace("\0", ""))) for name, folder in named.items()}


class Pipeline(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Content of pipeline.yaml.

    executor: `processes` of this machine, or the address of a Dask scheduler; it changes no bit and no key
    """

    format: Literal[1]
    stages: dict[StageName, Stage]
    executor: Executor = "processes"

    def order(self) -> list[str]:
        """Return the stages in a topological order, the same in every run."""
        return list(TopologicalSorter({name: stage.upstream for name, stage in self.stages.items()}).static_order())

    def check(self, stages: Sequence[str]) -> None:
        """Raise InputError for a name in `stages` that no stage has."""
        for name in (name for name in stages if name not in self.stages):
            near = did_you_mean(name, self.stages)
            cure = near if near.startswith("did") else "make help-all lists all verbs and stages"
            raise InputError(f"there is no verb or stage {name!r}", cure=cure)

    def for_data(self, is_empty: Callable[[str], bool]) -> Pipeline:
        """Return the pipeline without the stages whose slice (`Stage.when`) is empty in a dataset."""
        dropped = {name for name, stage in self.stages.items() if stage.when and is_empty(stage.when)}
        stages = {name: stage for name, stage in self.stages.items() if name not in dropped}
        for name, stage in stages.items():
            stages[name] = msgspec.structs.replace(stage, inputs=[each for each in stage.inputs if each not in dropped])
        return msgspec.structs.replace(self, stages=stages)

    def needed(self, targets: list[str] | None) -> list[str]:
        """Return the targets and all stages above them, in order; None stands for all stages that are not optional."""
        usual = [name for name, stage in self.stages.items() if not stage.optional]
        needed = set(usual if targets is None else targets)
        order = self.order()
        for name in reversed(order):
            if name in needed:
                needed.update(self.stages[name].upstream)
        return [name for name in order if name in needed]


def read_pipeline(path: Path, known_slices: tuple[str, ...]) -> Pipeline:
    """Read and check pipeline.yaml; `known_slices` are those that a dataset can have.

    Raises:
        InputError: The format or a name is unknown, or stages depend on each other in a cycle.
    """
    pipeline = read_yaml(path, Pipeline)

    def refuse(fault: str, key: str, cure: str) -> NoReturn:
        """Raise the error of one key of the file."""
        raise InputError(fault, file=path, key=key, cure=cure) from None

    known = [*(DATASET + name for name in known_slices), *pipeline.stages]
    for name, stage in pipeline.stages.items():
        if stage.gather is not None and stage.over != "photo":
            refuse("only a stage over photos can gather", f"stages.{name}.gather", "add over: photo")
        for entry in (entry for entry in stage.inputs if entry not in known):
            refuse(f"there is no stage or slice {entry!r}", f"stages.{name}.inputs", did_you_mean(entry, known))
        if stage.when is not None and stage.when not in known_slices:
            refuse(f"there is no slice {stage.when!r}", f"stages.{name}.when", did_you_mean(stage.when, known_slices))
        for other in (other for other in stage.params_of if other not in pipeline.stages):
            refuse(f"there is no stage {other!r}", f"stages.{name}.params_of", did_you_mean(other, pipeline.stages))
    try:
        pipeline.order()
    except CycleError as error:
        cycle = " <- ".join(error.args[1])
        refuse(
            f"stages need each other: {cycle}",
            "stages",
            "remove one of these inputs; for a second pass, declare a further stage",
        )
    return pipeline


def with_settings(pipeline: Pipeline, settings: Sequence[str]) -> Pipeline:
    """Replace values of the pipeline by settings `stage.parameter=value` and `executor=…`, several separated by blanks.

    `stage.preset=name` stands for the parameters of a preset; a later setting replaces one of these.

    >>> with_settings(Pipeline(1, {"solve": Stage()}), ["solve.lobes=64 solve.tolerance=1e-3"]).stages["solve"].params
    {'lobes': 64, 'tolerance': 0.001}
    >>> pipeline = Pipeline(1, {"solve": Stage(presets={"fast": {"lobes": 8, "steps": 2}})})
    >>> with_settings(pipeline, ["solve.preset=fast solve.steps=3"]).stages["solve"].params
    {'lobes': 8, 'steps': 3}
    >>> pipeline = Pipeline(1, {"solve": Stage(), "again": Stage(params_of=["solve"])})
    >>> with_settings(pipeline, ["solve.lobes=64"]).stages["again"].params
    {'solve': {'lobes': 64}}
    """
    stages = dict(pipeline.stages)
    executor = pipeline.executor
    for word in _words(settings):
        target, equals, text = word.partition("=")
        key = f"SET {one_line(word)}"
        if target == "executor":
            executor = convert(text, Executor, key)
            continue
        stage, *names = target.split(".")
        if not equals or not all(names) or not 0 < len(names) <= DEEPEST:
            cure = 'write stage.parameter=value, as in SET="solve.cells=800"'
            raise InputError(f"{one_line(word)!r} is not a setting", key="SET", cure=cure)
        if stage not in stages:
            raise InputError(f"there is no stage {stage!r}", key=key, cure=did_you_mean(stage, stages))
        if others := stages[stage].params_of:
            cure = f"set it of one of these: {others[0]}.{'.'.join(names)}=…"
            raise InputError(f"the stage {stage} has the parameters of {', '.join(others)}", key=key, cure=cure)
        table = params = dict(stages[stage].params)
        if names == ["preset"]:
            if text not in (presets := stages[stage].presets):
                cure = did_you_mean(text, presets) if presets else "leave it out: this stage has none"
                raise InputError(f"the stage {stage} has no preset {one_line(text)!r}", key=key, cure=cure)
            stages[stage] = msgspec.structs.replace(stages[stage], params=params | presets[text])
            continue
        for name in names[:-1]:
            inner = table.get(name)
            table[name] = dict(inner) if isinstance(inner, dict) else {}
            table = table[name]
        table[names[-1]] = _value(text, key)
        stages[stage] = msgspec.structs.replace(stages[stage], params=params)
    for name, each in stages.items():
        shared = {of: stages[of].values for of in each.params_of}
        stages[name] = msgspec.structs.replace(each, params=each.params | shared)
    return msgspec.structs.replace(pipeline, stages=stages, executor=executor)


def _value(text: str, key: str) -> Any:
    """Parse the value of a setting; InputError for one that JSON cannot hold."""
    try:
        value = parse_yaml(text, key)
        json_text(value).encode()
    except InputError:
        raise
    except ValueError as error:
        raise InputError(
            f"the value cannot be stored ({error})", key=key, cure="write a finite number or text"
        ) from None
    return value


def blame_setting(error: InputError, settings: Sequence[str]) -> InputError:
    """Return an error about a value of pipeline.yaml as one about the setting that replaced the value, if any."""
    for word in reversed(_words(settings)):
        stage, _, name = word.partition("=")[0].partition(".")
        key = f"stages.{stage}.params.{name}"
        if error.key == key or (error.key or "").startswith((f"{key}.", f"{key}[")):
            return InputError(error.fault, key=f"SET {one_line(word)}", cure=error.cure)
    return error


def _words(settings: Sequence[str]) -> list[str]:
    try:
        return [word for text in settings for word in shlex.split(text)]
    except ValueError as error:
        raise InputError(f"cannot be split into words ({error})", key="SET", cure="close every quote") from None
