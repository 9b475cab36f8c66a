"""Options of the solvers: names, ranges, defaults and meanings."""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta, Struct

Lobes = Annotated[int, Meta(ge=1, le=1024)]
Seed = Annotated[int, Meta(ge=0)]


class SolveOptions(Struct, frozen=True):
    """Options of the joint solve."""

    cells: Annotated[int, Meta(ge=12, le=1600)] = 400
    """Number of a light's cells before any of them splits; 400 cells are 10° apart."""
    splittings: Annotated[int, Meta(ge=0, le=8)] = 3
    """Largest number of splittings before materials are fitted, and of those after it.  Each splits the 24 cells of a
    light with most energy in about four, if the marginal likelihood supports it very strongly (log Bayes factor over
    5)."""
    observations: Annotated[int, Meta(ge=50)] = 1000
    """Largest number of a light's observations that materials are fitted to, drawn evenly; eight times as many if
    they are explained closely (mean robust loss under 0.5) and cells may split.  Lights alone are fitted to twice as
    many."""
    self_shadowing: Literal["auto", "on", "off"] = "auto"
    """Shadows of the meshes; auto: on, unless the marginal likelihood is very strongly against them (log Bayes factor
    below -5)."""
    interreflection: Literal["auto", "on", "off"] = "auto"
    """Light that surfaces send each other, as the photo shows it; needs self_shadowing.  auto: on, if the
    marginal likelihood supports it very strongly (log Bayes factor over 5)."""
    background: Literal["auto", "off"] = "auto"
    """Surroundings that photos show, as observations of the light; auto: with wider errors where the marginal
    likelihood of the objects is clearly against it (log Bayes factor plus two of its errors below -5), and at last
    not."""
    ground: Literal["auto", "off"] = "auto"
    """Shadows that objects cast on the ground, as observations of the light; auto: used if they lie where the light
    that the objects tell of casts them (correlation from 0.3 on)."""
    tone: Literal["auto", "off"] = "auto"
    """Tone curve of a photo beyond its encoding; auto: used if held-out observations support it by two standard errors
    (2.67 of six lights) and their loss is a quarter higher without it."""
    distance: Literal["auto", "off"] = "auto"
    """Finite distance of a light; auto: used if the marginal likelihood supports it very strongly (log Bayes factor
    less two of its errors over 5)."""
    seed: Seed = 0
    """Seed of the choice of held-out regions of mirror directions, and of the observations that are drawn."""
