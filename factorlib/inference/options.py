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
    observations: Annotated[int, Meta(ge=50)] = 1000
    """Most observations of a light that are fitted, drawn from all; eight times as many where splitting explains much more."""
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
