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
SpecularParts = Literal["auto", "on"]
ToneCurves = Literal["auto", "off"]


class Choices(Struct, frozen=True):
    """What of the bundle solver a user may choose.

    lobes           most lobes an illumination may get; held-out observations may stop earlier
    insert          lobes that each illumination gets in a round
    rounds          most rounds
    iterations      of the joint descent in a round
    polish, settle  iterations at the end, on four times the sample and on all observations
    sample          the least observations per illumination that choose the lobes (60 for each lobe where that is more)
    tolerance       a descent stops after two steps that gain less than this share of the loss
    least_gain      share of the held-out loss that a round must gain to be the best one
    self_shadowing  whether what meshes hide is taken to be dark; `auto`: where held-out observations are explained better so
    specular        whether every material has a specular part; `auto`: where held-out observations are explained worse without
    tone            whether photos may have a tone curve beyond their encoding; `auto`: where held-out observations ask for it
    seed            of samples and of what is held out
    """

    lobes: Lobes = 72
    insert: Inserted = 12
    rounds: Rounds = 12
    iterations: Iterations = 10
    polish: Polish = 20
    settle: Polish = 2
    sample: Sample = 1500
    tolerance: Tolerance = 1e-3
    least_gain: Share = 0.01
    self_shadowing: SelfShadowing = "auto"
    specular: SpecularParts = "auto"
    tone: ToneCurves = "auto"
    seed: Seed = 0


class Bundle(Choices, frozen=True):
    """How the joint problem is solved.

    start_roughness, start_specular_share   of the materials that rounds start from
    """

    start_roughness: float = 0.4
    start_specular_share: float = 0.2
