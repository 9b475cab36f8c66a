"""Levenberg–Marquardt over all materials and lights: damped steps, taken when they lower the loss.

Radiance is linear in the lobes' weights, and its derivatives by axes and sharpnesses are proportional to the weights.  So the step
predicts badly what happens where one lobe takes over the energy of another while it moves.  The weights of a step are therefore not
used: with lobes and materials where the step put them, the weights are fitted anew (an embedded point iteration; Jeong et al. 2012,
Hong et al. 2017).  That costs little, for the next system needs the same responses.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import msgspec
import numpy as np
from jaxtyping import Bool, Float

from factorlib.model.point import Point
from factorlib.model.problem import JointProblem
from factorlib.solve.few_lobes.arrow import ArrowSystem, Bounds
from factorlib.solve.few_lobes.normal_equations import normal_equations, with_weights_fitted
from factorlib.solve.few_lobes.unknowns import materials_at_bound, moved_point

DAMPING, LEAST_DAMPING = 1e-3, 1e-9
LESS, MORE = 2.5, 3.0  # the damping is divided by LESS after a good step, multiplied by MORE after a bad one
GOOD, BAD = 0.6, 0.2  # a step is good or bad if the loss fell by more or less than this share of the predicted decrease
ENOUGH = 2  # steps in a row that gain too little end a descent
TIGHTENINGS = 12


class Iterate(msgspec.Struct, frozen=True):
    """A point, and the system of a problem there."""

    point: Point
    system: ArrowSystem

    @property
    def loss(self) -> float:
        """The loss of the point: robust losses of what is fitted, and priors."""
        return self.system.loss


class Step(msgspec.Struct, frozen=True):
    """A step of all unknowns, and by how much the quadratic model falls with it."""

    materials: Float[np.ndarray, " 7m"]
    lights: list[Float[np.ndarray, " l"]]
    predicted: float


class Descent(msgspec.Struct, frozen=True):
    """When a descent stops: after `iterations`, or after two steps in a row that gain less than `tolerance` of the loss."""

    iterations: int = 10
    tolerance: float = 1e-4


def evaluate(problem: JointProblem, point: Point) -> Iterate:
    """The point with its system."""
    parts = problem.spread(partial(normal_equations, loss=problem.loss), problem.illuminations(point))
    return Iterate(point, ArrowSystem(list(parts), 7 * len(point.materials)))


def fit_weights(problem: JointProblem, point: Point) -> Iterate:
    """As `evaluate`, with the lobes' weights fitted first: those that lower the loss most while nothing else changes."""
    fits = list(problem.spread(partial(with_weights_fitted, loss=problem.loss), problem.illuminations(point)))
    system = ArrowSystem([one.equations for one in fits], 7 * len(point.materials))
    return Iterate(Point(point.materials, [one.light for one in fits]), system)


def descend(
    problem: JointProblem,
    start: Iterate,
    descent: Descent,
    accepted: Callable[[int, Iterate], object] = lambda iteration, iterate: None,
    fixed: Bool[np.ndarray, " 7m"] | None = None,
) -> Iterate:
    """Lower the loss from `start`, an iterate of this problem; every accepted point is reported with the number of its iteration.

    fixed: unknowns of the materials that stay as they are
    """
    current, damping, small = start, DAMPING, 0
    for iteration in range(descent.iterations):
        step = damped_step(current, damping, fixed)
        trial = fit_weights(problem, moved_point(current.point, step.materials, step.lights))
        gained, least = current.loss - trial.loss, descent.tolerance * current.loss
        if gained > 0:
            small = small + 1 if gained < least else 0
        else:
            small += step.predicted < least
        share = gained / max(step.predicted, 1e-300)
        damping = max(damping / LESS, LEAST_DAMPING) if share > GOOD else damping if share > BAD else damping * MORE
        if gained > 0:
            current = trial
            accepted(iteration, current)
        if small >= ENOUGH:
            break
    return current


def damped_step(at: Iterate, damping: float, fixed: Bool[np.ndarray, " 7m"] | None = None) -> Step:
    """The step at the given Levenberg–Marquardt `damping`.

    fixed: unknowns of the materials that stay as they are
    An unknown at a bound stays there if the loss would fall beyond it.  Other unknowns are clipped to their ranges after the step;
    weights are fitted anew instead.  While the step takes a sharpness out of its range, or moves a lobe farther than the quadratic
    model holds, it is solved again with tighter limits (`Bounds.tighten`), at most `TIGHTENINGS` times.
    """
    materials, system = at.point.materials, at.system
    free = ~materials_at_bound(materials, system.material_gradient) & (True if fixed is None else ~fixed)
    bounds = [Bounds(part, light, materials) for part, light in zip(system.parts, at.point.lights, strict=True)]
    for _ in range(TIGHTENINGS):
        by_materials, by_lights = system.solved(free, bounds, damping)
        tightened = [bound.tighten(step) for bound, step in zip(bounds, by_lights, strict=True)]
        if not any(tightened):
            break
    return Step(by_materials, by_lights, system.predicted_decrease(by_materials, by_lights))
