"""One damped Gauss–Newton step of all unknowns, within their bounds."""

from __future__ import annotations

import msgspec
import numpy as np
from jaxtyping import Bool, Float

from factorlib.solve.few_lobes.bounds import Bounds, materials_at_bound
from factorlib.solve.few_lobes.iterate import Iterate

TIGHTENINGS = 12


class Step(msgspec.Struct, frozen=True):
    """A step of all unknowns, and by how much the quadratic model falls with it."""

    materials: Float[np.ndarray, " 7m"]
    lights: list[Float[np.ndarray, " l"]]
    predicted: float


def damped_step(at: Iterate, damping: float, fixed: Bool[np.ndarray, " 7m"] | None = None) -> Step:
    """The step at the given Levenberg–Marquardt `damping`.

    fixed: unknowns of the materials that stay as they are
    An unknown at a bound stays there if the loss would fall beyond it.  Other unknowns are clipped to their ranges after the step;
    weights are fitted anew instead (descent).  While the step takes a sharpness out of its range, or moves a lobe farther than the
    quadratic model holds, it is solved again with tighter limits (`Bounds.tighten`), at most `TIGHTENINGS` times.
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
