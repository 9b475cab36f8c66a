"""What may be chosen of the solver of few lobes: names, ranges, defaults and what they mean, once; and a run of it."""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta, Struct

from factorlib.solve.history import Report, unreported
from factorlib.solve.options import Choices, Lobes


class LobeChoices(Choices, frozen=True):
    """What a user may choose of the solver of few lobes; of those of the joint solve it takes the seed alone."""

    lobes: Lobes = 72
    """Most lobes of an illumination; held-out observations may stop earlier."""
    insert: Annotated[int, Meta(ge=1, le=64)] = 12
    """Lobes that each illumination gets in a round."""
    rounds: Annotated[int, Meta(ge=1, le=100)] = 12
    """Most rounds of inserting lobes."""
    iterations: Annotated[int, Meta(ge=1, le=1000)] = 10
    """Iterations of the joint descent in a round."""
    polish: Annotated[int, Meta(ge=0, le=1000)] = 20
    """Iterations of the descent at the end, on four times the sample."""
    settle: Annotated[int, Meta(ge=0, le=1000)] = 2
    """Iterations of the descent at the very end, on all observations."""
    sample: Annotated[int, Meta(ge=50)] = 1500
    """Least number of observations of an illumination on which lobes are chosen; 60 for each lobe where that is more."""
    tolerance: Annotated[float, Meta(gt=0, lt=1)] = 1e-3
    """A descent stops after two steps that lower the loss by less than this share of it."""
    least_gain: Annotated[float, Meta(ge=0, lt=1)] = 0.01
    """Share of the held-out loss that a round must gain to be the best one; two rounds without gain are the last."""
    specular: Literal["auto", "on", "off"] = "auto"
    """Whether materials have a specular part: all, none, or (auto) those without which held-out observations are explained worse."""


class FewLobes(LobeChoices, frozen=True):
    """How the joint problem is solved with lights of few lobes.

    start_roughness, start_specular_share: of the materials that rounds start from
    """

    start_roughness: float = 0.4
    start_specular_share: float = 0.2


class Run(Struct, frozen=True):
    """options: how to solve;  report: called at every accepted point."""

    options: FewLobes = FewLobes()
    report: Report = unreported
