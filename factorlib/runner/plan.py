"""Plan of a run: the steps that must run, and why, as a pure function of declarations, hashes and the store's content.

A step's record is a flat table of everything its result depends on: its name, the source of every module it imports,
its parameters, its part of dataset.yaml, the content hashes of its inputs, versions of packages.  The record has no
time and no path outside the dataset.  The hash of the record is the step's key, and the difference of two records is
the reason for a rerun.  A step whose inputs are not made yet is a *maybe*: it reruns only if they come out different.
"""

import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Literal

import msgspec

from factorlib.runner.project import DATASET, Pipeline

Record = dict[str, Any]
Status = Literal["current", "to run", "maybe"]


class Step(msgspec.Struct, frozen=True, order=True):
    """One piece of work: a stage, of one photo, of one recipe, or of the whole set."""

    stage: str
    photo: str | None = None
    recipe: str | None = None

    @property
    def item(self) -> str:
        """Name of the photo or recipe; empty for a step over the whole set."""
        return self.photo or self.recipe or ""

    def __str__(self) -> str:
        return f"{self.stage}/{self.item}" if self.item else self.stage


class Spec(msgspec.Struct, frozen=True):
    """Requested stages, with photos and recipes, and the steps that run whatever the store holds."""

    pipeline: Pipeline
    photos: list[str]
    targets: list[str] | None = None
    forced: frozenset[Step] = frozenset()
    recipes: list[str] = []

    def steps(self) -> list[Step]:
        """Return all steps of the requested stages and of those that they need, upstream first."""
        return [step for name in self.pipeline.needed(self.targets) for step in self.steps_of(name)]

    def steps_of(self, stage: str) -> list[Step]:
        """Return the steps of one stage: one per photo or recipe, or one for the whole set."""
        over = self.pipeline.stages[stage].over
        if over == "recipe":
            return [Step(stage, recipe=recipe) for recipe in self.recipes]
        return [Step(stage, photo) for photo in self.photos] if over else [Step(stage)]

    def upstream(self, step: Step) -> list[Step]:
        """Return the steps whose results a step takes: those of its photo, or of all photos for another step."""
        names = self.pipeline.stages[step.stage].upstream
        if step.photo is None:
            return [above for name in names for above in self.steps_of(name)]
        return [Step(name, step.photo if self.pipeline.stages[name].over else None) for name in names]


class Listing(msgspec.Struct, frozen=True):
    """Content of the store, as far as a plan depends on it.

    outputs:  hash of the output by key; a mapping of which only `get` is called
    previous: each step's record when it last was current for this dataset
    damaged:  by key, the faults of a result that no longer has the files it was stored with, and so has no output
    """

    outputs: Any
    previous: Mapping[str, Record]
    damaged: Mapping[str, list[str]] = {}


class PlannedStep(msgspec.Struct, frozen=True):
    """Step with its status and the reasons for it.

    `record` and `key` are empty until all inputs are made, `output` until the step itself is.
    """

    step: Step
    status: Status
    reasons: list[str]
    record: Record = {}
    key: str = ""
    output: str = ""


def plan(spec: Spec, hashes: Mapping[Step, Record], listing: Listing) -> list[PlannedStep]:
    """Plan every requested step in order; `hashes` holds each step's record without the results of other steps."""
    planned: dict[Step, PlannedStep] = {}
    for step in spec.steps():
        outputs = {above: planned[above].output for above in spec.upstream(step)}
        planned[step] = _plan_step(step, step in spec.forced, hashes[step], outputs, listing)
    return list(planned.values())


def _plan_step(step: Step, forced: bool, base: Record, outputs: Mapping[Step, str], listing: Listing) -> PlannedStep:
    """Plan a step that takes these outputs, empty where one is still to be made.

    With such an input the step must run if something else of its record changed; otherwise that is open.
    """
    missing = [above for above, output in outputs.items() if not output]
    record = base | {f"input:{above}": output for above, output in outputs.items() if output}
    whole: Record = {} if missing else record
    key = "" if missing else hash_of(record)
    if forced:
        return PlannedStep(step, "to run", ["forced"], whole, key)
    if key and (output := listing.outputs.get(key)) is not None:
        return PlannedStep(step, "current", [], record, key, output)
    if key and (faults := listing.damaged.get(key)):
        return PlannedStep(step, "to run", [f"its result is damaged: {summarize(faults)}"], whole, key)
    if (before := listing.previous.get(str(step))) is None:
        return PlannedStep(step, "to run", ["not made yet"], whole, key)
    pending = {f"input:{above}" for above in missing}
    changes = difference({name: value for name, value in before.items() if name not in pending}, record)
    if missing and not changes:
        return PlannedStep(step, "maybe", [f"if {names(missing)} comes out different"])
    return PlannedStep(step, "to run", changes or ["its result is gone"], whole, key)


def hash_of(table: Record) -> str:
    """Return the hash of a step's record, which is its key, or of the files of a tree, which is its name."""
    return hashlib.sha256(json.dumps(table, sort_keys=True).encode()).hexdigest()[:32]


_LABELS = {
    "source": "source of {}",
    "param": "parameter {}",
    "recipe": "recipe: {}",
    "recipe file": "file {} of the recipe",
    "facts": "dataset.yaml: {}",
    "file": "file {}",
    "given": "given file {}",
    "input": "result of {}",
    "gathered": "gathered file of {}",
    "data": "package data {}",
    "environment": "environment variable {}",
    "program": "program {}",
    "package": "package {}",
}
_ABSENT = object()
_HASHED = ("source", "file", "recipe file", "given", "input", "data")
_LONGEST = 80  # characters of a value in a message


def difference(before: Record, after: Record) -> list[str]:
    """Describe the changes between two records, one line per field."""
    fields = sorted(before.keys() | after.keys())
    pairs = ((name, before.get(name, _ABSENT), after.get(name, _ABSENT)) for name in fields)
    return [_change(name, old, new) for name, old, new in pairs if old != new]


def _change(name: str, old: Any, new: Any) -> str:
    kind, colon, field = name.partition(":")
    label = _LABELS.get(kind, "{}").format(field.removeprefix(DATASET) if kind == "facts" else field) if colon else name
    if kind in _HASHED:
        return f"{label}: " + ("new" if old is _ABSENT else "gone" if new is _ABSENT else "changed")
    return f"{label}: {_format(old, kind)} -> {_format(new, kind)}"


def _format(value: Any, kind: str) -> str:
    if value is _ABSENT or (value is None and kind == "facts"):
        return {"facts": "not given", "param": "default"}.get(kind, "none")
    text = json.dumps(value, ensure_ascii=False)
    return text if len(text) <= _LONGEST else text[: _LONGEST - 1] + "…"


def summarize(lines: Sequence[object], most: int = 3, separator: str = "; ") -> str:
    """Join the first lines and the number of further ones.

    >>> summarize(["a: missing", "b: missing", "c: missing", "d: missing"])
    'a: missing; b: missing; c: missing; 1 more'
    """
    return separator.join([*map(str, lines[:most]), *([f"{len(lines) - most} more"] if len(lines) > most else [])])


def names(steps: Iterable[Step]) -> str:
    """Format steps by the names of their stages, with the number of photos.

    >>> names([Step("masks", "a"), Step("masks", "b"), Step("train")])
    'masks (2 photos), train'
    """
    groups: dict[str, list[Step]] = {}
    for step in steps:
        groups.setdefault(step.stage, []).append(step)
    kinds = {stage: "recipes" if group[0].recipe else "photos" for stage, group in groups.items()}
    return ", ".join(str(g[0]) if len(g) == 1 else f"{name} ({len(g)} {kinds[name]})" for name, g in groups.items())
