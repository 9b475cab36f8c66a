"""pipeline.yaml as types: the stages, what each takes, and the parameters that differ from their defaults."""

from __future__ import annotations

import json
import os
import re
import shlex
from collections.abc import Callable
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import Annotated, Any, Literal, NoReturn

import msgspec

from factorlib.errors import InputError, did_you_mean
from factorlib.runner.project import check_name
from factorlib.yamlfile import convert, parse_yaml, read_yaml

FORMAT = 1
SHOWN = 80  # characters of a setting that messages repeat
LONGEST, DEEPEST = 5000, 16  # characters of a setting, parts of its name: a path may have 4096
NAME = re.compile("[a-z][a-z0-9_]*")
TAKEN = ("errors",)  # a folder beside the links that are called as the stages
HOW = "write processes, or the address of a Dask scheduler, as tcp://10.0.0.1:8786"
WHERE = r"^(processes|(tcp|tls|ws|wss|ucx|ucxx)://[^\s/]+:\d+)$"
Executor = Annotated[str, msgspec.Meta(pattern=WHERE, description=HOW)]
DATASET = "dataset."  # prefix of the inputs that are slices of the dataset


class Shipping(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """folder: of the package, where the result lies;  made_by: the modules that its content follows from."""

    folder: str
    made_by: list[str]


class Stage(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One stage.

    inputs:  names of stages, or `dataset.<slice>`
    over:    `photo` for a step per photo, `recipe` for one per recipe that is asked for; otherwise one step for the whole set
    gather:  in a stage over photos, the file that every `<photo>.json` is gathered into
    makes:   files each step must write, `{photo}` standing for the photo's name; glob patterns
    threads: threads of its libraries' numerics, part of what is computed (a sum depends on them), never the machine's
    cores:   that it spreads independent work over by `Inputs.map`, `all` for those of the machine: they change no bit and no key
    logs:    hand it the log of the steps above it (not part of its key)
    when:    a slice of the set: where that says nothing, the stage is not there, and none takes its results
    optional: run it only where it is asked for, or something that is asked for takes its results
    given:   parameters that name a folder outside the dataset, and the files of it that the stage reads; the stage is handed
             the folder among its inputs, and the key has the files' contents, not where they lie
    shipped: the stage's result that comes with the source, taken where it was made by the same modules and parameters
    """

    inputs: list[str] = []
    over: Literal["photo", "recipe"] | None = None
    gather: str | None = None
    makes: list[str] = []
    threads: Annotated[int, msgspec.Meta(ge=1, le=64)] = 1
    cores: Annotated[int, msgspec.Meta(ge=1, le=1024)] | Literal["all"] = 1
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
        """The parameters that the stage itself takes."""
        return {name: value for name, value in self.params.items() if name not in self.given}

    @property
    def folders(self) -> dict[str, Path]:
        """The folders that parameters name, from where the user stands; links are followed now, for results move on."""
        named = {name: str(self.params[name]) for name in self.given if self.params.get(name) is not None}
        return {name: Path(os.path.realpath(folder.replace("\0", ""))) for name, folder in named.items()}


class Pipeline(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What pipeline.yaml says.

    executor: where steps run, which changes no bit and no key: `processes` of this machine, or the address of a Dask scheduler
    """

    format: int
    stages: dict[str, Stage]
    executor: Executor = "processes"

    def order(self) -> list[str]:
        """Stages, each after what it takes; otherwise as they stand in the file."""
        return list(TopologicalSorter({name: stage.upstream for name, stage in self.stages.items()}).static_order())

    def for_data(self, says_nothing: Callable[[str], bool]) -> Pipeline:
        """The stages that a data set has, by which slices of it say nothing (`Stage.when`)."""
        gone = {name for name, stage in self.stages.items() if stage.when and says_nothing(stage.when)}
        kept = {name: stage for name, stage in self.stages.items() if name not in gone}
        for name, stage in kept.items():
            kept[name] = msgspec.structs.replace(stage, inputs=[each for each in stage.inputs if each not in gone])
        return msgspec.structs.replace(self, stages=kept)

    def needed(self, targets: list[str] | None) -> list[str]:
        """The targets and everything above them, in order; for None all stages but the optional ones that none of them takes."""
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
    """The pipeline with `stage.parameter=value` words in place of its own, and `executor=…`; several words in one string are split.

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
        if not equals or not keys or not all(keys) or len(keys) > DEEPEST or len(word) > LONGEST:
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
    """The same error, of the setting where it is about one, not of the file whose value that replaces."""
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
