"""What a user may choose of the bundle solver."""

from __future__ import annotations

from typing import Literal

import msgspec

from factorlib.solve.normal_equations import Loss


class Bundle(msgspec.Struct, frozen=True):
    """How the joint problem is solved; `lobes` and `sample` (the least observations that rounds use) are counted per illumination."""

    lobes: int = 72
    insert: int = 12
    rounds: int = 12
    iterations: int = 10
    polish: int = 20
    settle: int = 2
    sample: int = 1500
    tolerance: float = 1e-3
    least_gain: float = 0.01
    start_roughness: float = 0.4
    start_specular_share: float = 0.2
    self_shadowing: Literal["auto", "on", "off"] = "auto"
    specular: Literal["auto", "on"] = "auto"
    tone: Literal["auto", "off"] = "auto"
    loss: Loss = Loss()
    seed: int = 0
