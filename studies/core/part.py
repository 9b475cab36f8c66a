"""A case of the study of the model's parts: a rendered set of chairs, solved with lights of few lobes and one part switched off."""

from __future__ import annotations

from typing import Any

import msgspec

from studies.core.study import Scale

PARTS: dict[str, tuple[str, dict[str, Any]]] = {
    "as-it-is": ("as it is", {}),
    "shadows": ("no shadows", {"shadows": False, "bounces": False}),
    "bounce": ("no bounce", {"bounces": False}),
    "normals": ("all normals sure", {"seen": "sure"}),
    "robust": ("squares", {"robust_scale": 1e6}),
    "clipped-as-data": ("clipped as data", {"seen": "unclipped"}),
    "clipped-left-out": ("clipped left out", {"seen": "dropped"}),
}


class Part(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """part: of `PARTS`;  solve: further options of the solver of few lobes"""

    seed: int
    part: str
    solve: dict[str, Any] = {}


class Chairs(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The sets that the study shows, one a seed: so many shots (`factorlib/generate/eames.yaml`) of so many pixels."""

    seeds: tuple[int, ...]
    shots: int
    width: int
    height: int
    spp: int
    light_rows: int


def chairs_of(scale: Scale) -> Chairs:
    """The sets of a scale; small ones, since a study is of many solves."""
    if scale.name == "quick":
        return Chairs(scale.seeds, shots=2, width=120, height=90, spp=16, light_rows=32)
    return Chairs(scale.seeds, shots=4, width=240, height=180, spp=64, light_rows=64)
