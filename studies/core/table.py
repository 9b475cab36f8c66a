"""What is written of studies, as types that need no science: table.json."""

from __future__ import annotations

from typing import Literal

import msgspec

from studies.core.study import Claim

Verdict = Literal["lower", "higher", "not shown", "too few seeds"]


class Spread(msgspec.Struct, frozen=True):
    """Over `seeds` seeds.  deviation, low, high: of the sample, and the ends of the mean's interval; None of one seed."""

    mean: float
    seeds: int
    deviation: float | None = None
    low: float | None = None
    high: float | None = None


class Difference(msgspec.Struct, frozen=True):
    """first − second over the seeds that both have, and what it shows of the first."""

    spread: Spread
    verdict: Verdict


class Cell(msgspec.Struct, frozen=True):
    """A measure in a setting: its spread, each seed's value, and what the null scores, where it has one."""

    spread: Spread
    values: dict[int, float]
    nulls: dict[int, float] = {}

    @property
    def null(self) -> float | None:
        """The mean over seeds of what the null scores."""
        return sum(self.nulls.values()) / len(self.nulls) if self.nulls else None


class Row(msgspec.Struct, frozen=True):
    """A setting: its cells by measure; a measure that it does not have is left out."""

    name: str
    label: str
    x: float
    cells: dict[str, Cell]


class Tested(msgspec.Struct, frozen=True):
    """A claim, what the seeds say of it, and that as a sentence."""

    claim: Claim
    difference: Difference
    answer: str
    sentence: str


class Picture(msgspec.Struct, frozen=True):
    """A PNG file of a study's folder pictures/, and what it shows."""

    file: str
    caption: str


class Conclusion(msgspec.Struct, frozen=True):
    """All of a study's table.json.

    label:  what stands beside everything that is shown of a quick study; empty of a full one
    notes:  sentences that are no claims
    answer: to the paper, where it is not that of the claims
    over:   what intervals are over
    """

    study: str
    title: str
    question: str
    paper: str
    varied: str
    scale: str
    label: str
    seeds: tuple[int, ...]
    measures: tuple[str, ...]
    rows: list[Row]
    claims: list[Tested]
    pictures: list[Picture] = []
    over: str = "seeds"
    notes: list[str] = []
    answer: str = ""
