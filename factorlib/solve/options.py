"""What a user may choose of the bundle solver: names, ranges, defaults and what they mean, once."""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta, Struct

Lobes = Annotated[int, Meta(ge=1, le=1024)]
Inserted = Annotated[int, Meta(ge=1, le=64)]
Rounds = Annotated[int, Meta(ge=1, le=100)]
Iterations = Annotated[int, Meta(ge=1, le=1000)]
Polish = Annotated[int, Meta(ge=0, le=1000)]
Sample = Annotated[int, Meta(ge=50)]
Tolerance = Annotated[float, Meta(gt=0, lt=1)]
Share = Annotated[float, Meta(ge=0, lt=1)]
Seed = Annotated[int, Meta(ge=0)]
SelfShadowing = Literal["auto", "on", "off"]
Interreflection = Literal["auto", "on", "off"]
SpecularParts = Literal["auto", "on"]
ToneCurves = Literal["auto", "off"]
LightPriors = Literal["auto", "on", "none"]


class Choices(Struct, frozen=True):
    """What of the bundle solver a user may choose."""

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
    """Least number of observations of an illumination on which lobes are chosen; 60 for each lobe where that is more, and 5,000 under the light prior."""
    tolerance: Tolerance = 1e-3
    """A descent stops after two steps that lower the loss by less than this share of it."""
    least_gain: Share = 0.01
    """Share of the held-out loss that a round must gain to be the best one; two rounds without gain are the last."""
    self_shadowing: SelfShadowing = "auto"
    """Whether what meshes hide of the light is dark; auto: where that explains held-out observations better."""
    interreflection: Interreflection = "auto"
    """Whether surfaces that hide the light send their own, as the photo shows it; auto: where that explains held-out observations better."""
    specular: SpecularParts = "auto"
    """Whether every material has a specular part; auto: where held-out observations are explained
    worse without; all of them where lights follow the statistics of natural light."""
    tone: ToneCurves = "auto"
    """Whether a photo may have a tone curve beyond its encoding; auto: where held-out observations are explained better with one."""
    light_prior: LightPriors = "auto"
    """Whether lights follow the statistics of natural light (`factorlib.light.prior`) instead of being a few lobes; auto: unless
    lobes explain held-out observations to .35 of the noise model's variance."""
    seed: Seed = 0
    """Seed of the samples, and of what is held out."""


class Bundle(Choices, frozen=True):
    """How the joint problem is solved.

    start_roughness, start_specular_share   of the materials that rounds start from
    """

    start_roughness: float = 0.4
    start_specular_share: float = 0.2
