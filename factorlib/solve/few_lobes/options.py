"""What may be chosen of the solver of few lobes: names, ranges, defaults and what they mean, once."""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta

from factorlib.solve.options import Choices, Lobes

Inserted = Annotated[int, Meta(ge=1, le=64)]
Rounds = Annotated[int, Meta(ge=1, le=100)]
Iterations = Annotated[int, Meta(ge=1, le=1000)]
Polish = Annotated[int, Meta(ge=0, le=1000)]
Sample = Annotated[int, Meta(ge=50)]
Tolerance = Annotated[float, Meta(gt=0, lt=1)]
Share = Annotated[float, Meta(ge=0, lt=1)]
SpecularParts = Literal["auto", "on", "off"]


class LobeChoices(Choices, frozen=True):
    """What a user may choose of the solver of few lobes; of those of the joint solve it takes the seed alone."""

    lobes: Lobes = 72
    """Most lobes of an illumination; held-out observations may stop earlier."""
    insert: Inserted = 12
    """Lobes that each illumination gets in a round."""
    rounds: Rounds = 12
    """Most rounds of inserting lobes."""
    iterations: Iterations = 10
    """Iterations of the joint descent in a round."""
    polish: Polish = 20
    """Iterations of the descent at the end, on four times the sample."""
    settle: Polish = 2
    """Iterations of the descent at the very end, on all observations."""
    sample: Sample = 1500
    """Least number of observations of an illumination on which lobes are chosen; 60 for each lobe where that is more."""
    tolerance: Tolerance = 1e-3
    """A descent stops after two steps that lower the loss by less than this share of it."""
    least_gain: Share = 0.01
    """Share of the held-out loss that a round must gain to be the best one; two rounds without gain are the last."""
    specular: SpecularParts = "auto"
    """Whether materials have a specular part: all, none, or (auto) those without which held-out observations are explained worse."""


class FewLobes(LobeChoices, frozen=True):
    """How the joint problem is solved with lights of few lobes.

    start_roughness, start_specular_share: of the materials that rounds start from
    """

    start_roughness: float = 0.4
    start_specular_share: float = 0.2
