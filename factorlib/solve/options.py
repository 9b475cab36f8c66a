"""What a user may choose of the solvers: names, ranges, defaults and what they mean, once."""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta, Struct

Lobes = Annotated[int, Meta(ge=1, le=1024)]
Seed = Annotated[int, Meta(ge=0)]


class Choices(Struct, frozen=True):
    """A user may choose these of the joint solve."""

    cells: Annotated[int, Meta(ge=12, le=1600)] = 400
    """Cells of a light before any of them splits; 400 are 10° apart."""
    splittings: Annotated[int, Meta(ge=0, le=8)] = 3
    """How often the 24 cells of each light that hold most energy may split, each in about four; held-out observations stop it earlier."""
    observations: Annotated[int, Meta(ge=50)] = 4000
    """Most observations of a light that are fitted, drawn from all."""
    self_shadowing: Literal["auto", "on", "off"] = "auto"
    """Whether what meshes hide of the light is dark; auto: unless held-out observations are two standard errors against it."""
    interreflection: Literal["auto", "on", "off"] = "auto"
    """Whether surfaces that hide the light send their own, as the photo shows it, which needs self_shadowing; auto: where held-out observations are two standard
    errors for it."""
    tone: Literal["auto", "off"] = "auto"
    """Whether a photo may have a tone curve beyond its encoding; auto: where held-out observations are two standard errors for one, and their
    loss is a quarter higher without."""
    distance: Literal["auto", "off"] = "auto"
    """Whether a light may be at a finite distance; auto: where held-out observations are for one, by two standard errors
    or, in part, by more than one."""
    seed: Seed = 0
    """Seed of what is held out, and of the observations that are drawn."""


class FewLobes(Choices, frozen=True):
    """A user may choose these of the solver of few lobes; of those of the joint solve it takes the seed alone."""

    lobes: Lobes = 72
    """Most lobes of an illumination; held-out observations may stop earlier."""
    insert: Annotated[int, Meta(ge=1, le=64)] = 12
    """Lobes that each illumination gets in a round."""
    rounds: Annotated[int, Meta(ge=1, le=100)] = 12
    """Most rounds of inserting lobes."""
    iterations: Annotated[int, Meta(ge=1, le=1000)] = 10
    """Iterations of the joint descent in a round."""
    polish: Annotated[int, Meta(ge=0, le=1000)] = 20
    """Iterations of the descent at the end, on four times the sample; at most two more follow on all observations."""
    sample: Annotated[int, Meta(ge=50)] = 1500
    """Least number of observations of an illumination on which lobes are chosen; 60 for each lobe where that is more."""
