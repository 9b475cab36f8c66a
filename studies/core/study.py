"""What a study says of itself: settings, measures, claims; and how large it is, quick or full."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Literal

import msgspec

from studies.core.case import NAMES, Case, World
from studies.core.entries import Entry


class Scale(msgspec.Struct, frozen=True):
    """How large a study is: at most `largest` materials and lights; `side` of each where something else is varied."""

    name: Literal["full", "quick"]
    seeds: tuple[int, ...]
    largest: int
    side: int
    size: int
    solve: dict[str, Any]
    light_rows: int = 64
    light_spp: int = 8

    @property
    def square(self) -> str:
        """The name of the setting of all entries of `side` materials in as many lights, unperturbed."""
        return f"{self.side}x{self.side}"

    @property
    def entry_pixels(self) -> int:
        """About as many as a sphere has that grazing ones are left out of."""
        return round(0.77 * self.size**2)

    @property
    def worlds(self) -> World:
        """What the studies of this scale show, equal for all of them, so that it is made once."""
        return World(self.seeds, self.largest, self.light_rows, self.light_spp)

    def case(self, seed: int, entries: Sequence[Entry], **how: Any) -> Case:
        """A case of this size; how: further fields of it."""
        return Case(seed, tuple(sorted(entries)), self.size, solve={**self.solve, **how.pop("solve", {})}, **how)

    def setting(self, name: str, label: str, x: float, entries: Sequence[Entry] | None = None, **how: Any) -> Setting:
        """One of such cases, of equal entries for all seeds; None: of `side` materials in as many lights."""
        seen = full_matrix(self.side, self.side) if entries is None else entries
        return Setting(name, label, x, lambda seed: self.case(seed, seen, **how))

    def matrix(self, x: float, materials: int, lights: int) -> Setting:
        """All of so many materials in so many lights."""
        return self.setting(f"{materials}x{lights}", f"{materials} × {lights}", x, full_matrix(materials, lights))


FEW_LOBES = {"solver": "few_lobes", "lobes": 16, "insert": 8, "rounds": 2, "iterations": 6, "polish": 6}
FULL = Scale("full", seeds=(0, 1, 2, 3, 4), largest=len(NAMES), side=3, size=32, solve={})
QUICK = Scale("quick", seeds=(0,), largest=3, side=2, size=16, solve=FEW_LOBES, light_rows=32, light_spp=8)


class Setting(msgspec.Struct, frozen=True):
    """One value of what a study varies.

    name:  a word of a-z, 0-9 and -, part of file names;  label: as figures and tables write it
    x:     where it stands on the axis
    case:  the case of a seed, in the form that the kind of the study takes
    """

    name: str
    label: str
    x: float
    case: Callable[[int], msgspec.Struct]


class Rise(msgspec.Struct, frozen=True, tag=True):
    """How much a measure rises from one setting to another, for each of the `per` units that they are apart."""

    start: str
    end: str
    per: float


class Guess(msgspec.Struct, frozen=True, tag=True):
    """What a guess that knows mean colours alone scores in a setting: the null of its measure."""

    setting: str


Side = str | Rise | Guess  # of a comparison; str: a setting


class Claim(msgspec.Struct, frozen=True):
    """A comparison that the study makes: the measure, or its rise, is lower on the side `lower` than on `higher`.

    words: the claim as a sentence's subject;  paper: whether the paper says so, rather than this project
    """

    measure: str
    lower: Side
    higher: Side
    words: str
    paper: bool = True

    @property
    def settings(self) -> list[str]:
        """The names of all that are compared."""
        return [name for side in (self.lower, self.higher) for name in settings_of(side)]


def settings_of(side: Side) -> list[str]:
    """The names of the settings of one side of a claim."""
    match side:
        case Rise(start, end):
            return [start, end]
        case Guess(setting):
            return [setting]
        case _:
            return [side]


class Study(msgspec.Struct, frozen=True):
    """What is varied and measured.

    paper:     the paper's conclusion
    varied:    what the axis shows, with its unit
    measures:  those of the figure, the first the main one
    kind:      of its cases: its steps are in studies/steps/<kind>, joined by studies/run/pipelines/<kind>.yaml
    spread:    what stands in the place of seeds, where these are not what intervals are over;  over: what that is called
    """

    name: str
    title: str
    question: str
    paper: str
    varied: str
    measures: tuple[str, ...]
    settings: Callable[[Scale], list[Setting]]
    claims: Callable[[Scale], list[Claim]]
    kind: str = "spheres"
    spread: Callable[[Scale], tuple[int, ...]] | None = None
    over: str = "seeds"

    def seeds_of(self, scale: Scale) -> tuple[int, ...]:
        """The numbers of a setting's cases."""
        return self.spread(scale) if self.spread else scale.seeds

    def cases(self, scale: Scale) -> dict[str, msgspec.Struct]:
        """All cases by name: settings in order, each with all seeds."""
        return {
            case_name(setting.name, seed): setting.case(seed)
            for setting in self.settings(scale)
            for seed in self.seeds_of(scale)
        }


def case_name(setting: str, seed: int) -> str:
    """The name of a case's files.

    >>> case_name("3x3", 0)
    '3x3-seed0'
    """
    return f"{setting}-seed{seed}"


def full_matrix(materials: int, lights: int) -> list[Entry]:
    """Every material in every light.

    >>> full_matrix(1, 2)
    [(0, 0), (0, 1)]
    """
    return [(m, li) for m in range(materials) for li in range(lights)]
