"""One damped Gauss–Newton step of all unknowns, within their bounds."""

from __future__ import annotations

import msgspec
import numpy as np
from jaxtyping import Bool, Float

from factorlib.solve.bounds import Bounds, materials_at_bound
from factorlib.solve.iterate import Iterate

TIGHTENINGS = 12


class Step(msgspec.Struct, frozen=True):
    """A step of all unknowns, and by how much the quadratic model falls with it."""

    materials: Float[np.ndarray, "7m"]
    lights: list[Float[np.ndarray, "l"]]
    predicted: float


def damped_step(at: Iterate, damping: float, fixed: Bool[np.ndarray, "7m"] | None = None) -> Step:
    """The step at the given Levenberg–Marquardt `damping`.

    fixed: unknowns of the materials that stay as they are
    An unknown at a bound that the gradient pushes outward stays there; the others are clipped after the step, but for the weights,
    which are fitted anew where it leads (descent).  Solved again, at most `TIGHTENINGS` times, while the step takes a sharpness out
    of bounds or a lobe farther than the quadratic model is good for (`Bounds.tighten`).
    """
    materials, system = at.point.materials, at.system
    free = ~materials_at_bound(materials, system.material_gradient) & (True if fixed is None else ~fixed)
    bounds = [Bounds(part, light, materials) for part, light in zip(system.parts, at.point.lights, strict=True)]
    for _ in range(TIGHTENINGS):
        by_materials, by_lights = system.solved(free, bounds, damping)
        changed = [bound.tighten(step) for bound, step in zip(bounds, by_lights, strict=True)]
        if not any(changed):
            break
    return Step(by_materials, by_lights, system.predicted_decrease(by_materials, by_lights))
