"""What must run, and why: a pure function of what is declared, what it all hashes to, and what the store holds.

A step's record is a flat table of everything its result depends on: its name, the source of every module it imports,
its parameters, what dataset.yaml says that it sees, its inputs' content hashes, versions.  No path outside the dataset
and no time is in it.  Its key is the hash of that table, the difference of two tables is the reason for a rerun, and a
step whose inputs are not made yet is a *maybe*: it reruns only if they come out different.
"""

from __future__ import annotations

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
    def of(self) -> str | None:
        """Return the name of its photo or recipe."""
        return self.photo or self.recipe

    def __str__(self) -> str:
        return f"{self.stage}/{self.of}" if self.of else self.stage


class Spec(msgspec.Struct, frozen=True):
    """Stages that are wanted, with their photos and recipes, and the steps that run whatever the store holds."""

    pipeline: Pipeline
    photos: list[str]
    targets: list[str] | None = None
    forced: frozenset[Step] = frozenset()
    recipes: list[str] = []

    def steps(self) -> list[Step]:
        """Return all steps of the wanted stages and of what they need, upstream first."""
        return [step for name in self.pipeline.needed(self.targets) for step in self.steps_of(name)]

    def steps_of(self, stage: str) -> list[Step]:
        """Return the steps of one stage: one per photo or recipe, or one for the whole set."""
        over = self.pipeline.stages[stage].over
        if over == "recipe":
            return [Step(stage, recipe=recipe) for recipe in self.recipes]
        return [Step(stage, photo) for photo in self.photos] if over else [Step(stage)]

    def above(self, step: Step) -> list[Step]:
        """Return the steps whose results a step takes.

        These are of its own photo, or of all for a step over the whole set or of a recipe.
        """
        upstream = self.pipeline.stages[step.stage].upstream
        if step.photo is None:
            return [found for name in upstream for found in self.steps_of(name)]
        return [Step(name, step.photo if self.pipeline.stages[name].over else None) for name in upstream]


class Listing(msgspec.Struct, frozen=True):
    """Contents of the store: output hash by key (asked by `get`); and each step's record when it last was current here.

    damaged: by key, what is wrong with a result that is not as it was kept, and so has no output
    """

    outputs: Any
    previous: Mapping[str, Record]
    damaged: Mapping[str, list[str]] = {}


class Planned(msgspec.Struct, frozen=True):
    """Step, what is done about it, and why.

    It has its key and record where all its inputs are known, and its output where made.
    """

    step: Step
    status: Status
    reasons: list[str]
    record: Record | None = None
    key: str | None = None
    output: str | None = None


def plan(spec: Spec, hashes: Mapping[Step, Record], listing: Listing) -> list[Planned]:
    """Plan every wanted step in order; `hashes` holds each step's record but for the results it is handed."""
    planned: dict[Step, Planned] = {}
    for step in spec.steps():
        outputs = {above: planned[above].output for above in spec.above(step)}
        planned[step] = _planned(step, step in spec.forced, hashes[step], outputs, listing)
    return list(planned.values())


def _planned(step: Step, forced: bool, own: Record, outputs: Mapping[Step, str | None], listing: Listing) -> Planned:
    """Plan a step that is handed those outputs, None where one is still to be made.

    Under such a one it must run if what is known already changed; else that is open.
    """
    unmade = [above for above, output in outputs.items() if output is None]
    record = own | {f"input:{above}": output for above, output in outputs.items() if output is not None}
    whole, key = (None, None) if unmade else (record, step_key(record))
    if forced:
        return Planned(step, "to run", ["forced"], whole, key)
    if key and (output := listing.outputs.get(key)) is not None:
        return Planned(step, "current", [], whole, key, output)
    if key and key in listing.damaged:
        return Planned(step, "to run", [f"its result is damaged: {in_short(listing.damaged[key])}"], whole, key)
    if (before := listing.previous.get(str(step))) is None:
        return Planned(step, "to run", ["not made yet"], whole, key)
    waiting = {f"input:{above}" for above in unmade}
    changes = difference({name: value for name, value in before.items() if name not in waiting}, record)
    if unmade and not changes:
        return Planned(step, "maybe", [f"if {names(unmade)} comes out different"])
    return Planned(step, "to run", changes or ["its result is gone"], whole, key)


def step_key(record: Record) -> str:
    """Return the key of a step: the hash of its record, the same on any machine."""
    return hash_of(record)


def hash_of(table: Record) -> str:
    """Return the hash of a table: of a step's record, or of the files of a tree, which is named by it."""
    return hashlib.sha256(json.dumps(table, sort_keys=True).encode()).hexdigest()[:32]


_KIND = {
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
_LONGEST = 80  # characters of a value that are shown
_NAMED = 4  # names that came or went


def difference(before: Record, after: Record) -> list[str]:
    """List what changed between two records, in words, one line per cause."""
    both = sorted(before.keys() | after.keys())
    return [_change(name, before, after) for name in both if before.get(name, _ABSENT) != after.get(name, _ABSENT)]


def _change(name: str, before: Record, after: Record) -> str:
    kind, colon, what = name.partition(":")
    label = _KIND.get(kind, "{}").format(what.removeprefix(DATASET) if kind == "facts" else what) if colon else name
    old, new = before.get(name, _ABSENT), after.get(name, _ABSENT)
    if kind in _HASHED:
        return f"{label}: " + ("new" if old is _ABSENT else "gone" if new is _ABSENT else "changed")
    if isinstance(old, list) and isinstance(new, list):
        came, gone = [name for name in new if name not in old], [name for name in old if name not in new]
        if came + gone and all(isinstance(name, str) for name in came + gone):
            moved = [*(f"{name!r} came" for name in came[:_NAMED]), *(f"{name!r} went" for name in gone[:_NAMED])]
            return f"{label}: {', '.join(moved)}"
    return f"{label}: {_shown(old, kind)} -> {_shown(new, kind)}"


def _shown(value: Any, kind: str) -> str:
    if value is _ABSENT or (value is None and kind == "facts"):
        return {"facts": "not given", "param": "default"}.get(kind, "none")
    text = json.dumps(value, ensure_ascii=False)
    return text if len(text) <= _LONGEST else text[: _LONGEST - 1] + "…"


def in_short(lines: Sequence[object], most: int = 3, between: str = "; ") -> str:
    """Return the first lines, and how many more there are.

    >>> in_short(["a: missing", "b: missing", "c: missing", "d: missing"])
    'a: missing; b: missing; c: missing; 1 more'
    """
    return between.join([*map(str, lines[:most]), *([f"{len(lines) - most} more"] if len(lines) > most else [])])


def names(steps: Iterable[Step]) -> str:
    """Format steps by the name of their stage, with the number of photos.

    >>> names([Step("masks", "a"), Step("masks", "b"), Step("train")])
    'masks (2 photos), train'
    """
    groups: dict[str, list[Step]] = {}
    for step in steps:
        groups.setdefault(step.stage, []).append(step)
    kinds = {stage: "recipes" if found[0].recipe else "photos" for stage, found in groups.items()}
    return ", ".join(str(f[0]) if len(f) == 1 else f"{s} ({len(f)} {kinds[s]})" for s, f in groups.items())
