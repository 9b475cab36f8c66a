"""Levenberg–Marquardt over all materials and lights of few lobes: steps (1) of `factorlib.solve.arrow`, taken when they lower the loss.

Unknowns that are not free stay out of a step.

Radiance is linear in the lobes' weights, and its derivatives by axes and sharpnesses are proportional to the weights.  So the step
predicts badly what happens where one lobe takes over the energy of another while it moves.  The weights of a step are therefore not
used: with lobes and materials where the step put them, the weights are fitted anew (an embedded point iteration; Jeong et al. 2012,
Hong et al. 2017).  That costs little, for the next system needs the same responses.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import msgspec
import numpy as np
from jaxtyping import Bool, Float

from factorlib.model.lights import Light
from factorlib.model.materials import SHARPNESS, Materials, Point
from factorlib.model.problem import JointProblem
from factorlib.solve.arrow import System, damped, eliminate, information, summed
from factorlib.solve.few_lobes.equations import normal_equations, with_weights_fitted
from factorlib.solve.few_lobes.unknowns import light_at_bound, materials_at_bound, moved_point

DAMPING, LEAST_DAMPING = 1e-3, 1e-9
LESS, MORE = 2.5, 3.0  # the damping is divided by LESS after a good step, multiplied by MORE after a bad one
GOOD, BAD = 0.6, 0.2  # a step is good or bad if the loss fell by more or less than this share of the predicted decrease
ENOUGH = 2  # steps in a row that gain too little end a descent
MOST_WIDTHS, MOST_TURN, MOST_S = 0.4, 0.3, 0.25  # of a lobe in one step: its own widths, radians, s
TIGHTENINGS = 12
DEFINITE = 1e-9  # damping that makes a light's block definite where the step itself is not damped


class Bounds:
    """The limits of one light's step.

    free    [l] unknowns that the step may choose
    fixed   [l] the step of those that are not free
    extra   [l] damping of an unknown of its own, added to the common damping

    At the start an unknown is not free if it is at a bound and the loss would fall beyond it.  `tighten` adds further limits.
    """

    def __init__(self, equations: System, light: Light, materials: Materials):
        self.light, self.diagonal = light, np.diag(equations.light_hessian)
        self.free = ~light_at_bound(light, materials, equations.light_gradient)
        self.fixed, self.extra = np.zeros(len(self.free)), np.zeros(len(self.free))
        p = len(light)
        self.low, self.high = np.full(len(self.free), -np.inf), np.full(len(self.free), np.inf)
        s_now, s_low, s_high = (
            -np.log(1 / x + materials.blur) for x in (light.sharpness, SHARPNESS[0], materials.sharpest)
        )
        self.low[2 * p : 3 * p], self.high[2 * p : 3 * p] = s_low - s_now, s_high - s_now

    def tighten(self, step: Float[np.ndarray, " l"]) -> bool:
        """Tighten the limits where the step violates them; returns whether any was changed.

        A sharpness that would leave its range is fixed at the end of the range.  A lobe that moves too far gets more damping.
        """
        p = len(self.light)
        outside = self.free & ((step < self.low) | (step > self.high))
        self.free &= ~outside
        self.fixed[outside] = np.clip(step, self.low, self.high)[outside]
        turn = np.hypot(step[:p], step[p : 2 * p]) / np.minimum(MOST_WIDTHS / np.sqrt(self.light.sharpness), MOST_TURN)
        far = np.zeros(len(step), bool)
        far[: 2 * p] = np.tile(turn > 1, 2)
        far[2 * p : 3 * p] = np.abs(step[2 * p : 3 * p]) > MOST_S
        far &= self.free
        self.extra[far] = np.maximum(6 * self.extra[far], 1e-3 * self.diagonal[far])
        return bool(outside.any() or far.any())


class Iterate(msgspec.Struct, frozen=True):
    """A point, and the normal equations of all illuminations there.  Sums are taken in their order, so that equal inputs give equal bits."""

    point: Point
    parts: list[System]

    @property
    def loss(self) -> float:
        """The loss of the point: robust losses of what is fitted, and priors."""
        return sum(part.value for part in self.parts)

    def of_materials(self) -> tuple[Float[np.ndarray, "7m 7m"], Float[np.ndarray, " 7m"]]:
        """M and g_m."""
        size = 7 * len(self.point.materials)
        return summed(self.parts, np.zeros((size, size)), np.zeros(size))

    def solved(
        self, free: Bool[np.ndarray, " 7m"], bounds: Sequence[Bounds], damping: float
    ) -> tuple[Float[np.ndarray, " 7m"], list[Float[np.ndarray, " l"]]]:
        """The damped step of the `free` unknowns of the materials, and of each light within its bounds."""
        M, g = self.of_materials()
        M, parts, dm = damped(M, damping), [], np.zeros(len(g))
        for part, bound in zip(self.parts, bounds, strict=True):
            g[part.places] += part.cross_hessian @ bound.fixed
            L = damped(part.light_hessian, damping) + np.diag(bound.extra)
            gradient = part.light_gradient + part.light_hessian @ bound.fixed
            parts.append(held(part._replace(light_hessian=L, light_gradient=gradient), ~bound.free))
        solutions = eliminate(parts, M, g)
        dm[free] = np.linalg.solve(M[np.ix_(free, free)], -g[free])
        dl = [
            bound.fixed - (solution[:, -2] + solution[:, :-2] @ dm[part.places]) * bound.free
            for part, bound, solution in zip(parts, bounds, solutions, strict=True)
        ]
        return dm, dl

    def predicted_decrease(self, dm: Float[np.ndarray, " 7m"], dl: Sequence[Float[np.ndarray, " l"]]) -> float:
        """Return by how much a step lowers the quadratic model of the loss."""
        M, g = self.of_materials()
        decrease = -dm @ (2 * g + M @ dm)
        for part, step in zip(self.parts, dl, strict=True):
            L, C = part.light_hessian, part.cross_hessian
            decrease -= step @ (2 * part.light_gradient + L @ step + 2 * C.T @ dm[part.places])
        return float(decrease)

    def information(self) -> tuple[Float[np.ndarray, "7m 7m"], list[Float[np.ndarray, "g 7m"]]]:
        """Return the information of `factorlib.solve.arrow`, unknowns of lights that are at a bound held."""
        parts = [
            held(
                part._replace(light_hessian=damped(part.light_hessian, DEFINITE)),
                light_at_bound(light, self.point.materials, part.light_gradient),
            )
            for part, light in zip(self.parts, self.point.lights, strict=True)
        ]
        return information(parts, 7 * len(self.point.materials))


def held(part: System, which: Bool[np.ndarray, " l"]) -> System:
    """The system without `which` of the light's unknowns: their rows and columns become those of the identity, in the scale of the rest."""
    free, scale = ~which, max(float(np.abs(np.diag(part.light_hessian)).mean()), 1e-30)
    L = part.light_hessian * np.outer(free, free)
    L[which, which] = scale
    scores = None if part.scores is None else part.scores * np.append(np.ones(len(part.places), bool), free)
    gradient, cross = part.light_gradient * free, part.cross_hessian * free
    return part._replace(light_hessian=L, light_gradient=gradient, cross_hessian=cross, scores=scores)


def evaluate(problem: JointProblem, point: Point) -> Iterate:
    """The point with its system."""
    return Iterate(
        point, list(problem.spread(partial(normal_equations, loss=problem.loss), problem.illuminations(point)))
    )


def fit_weights(problem: JointProblem, point: Point) -> Iterate:
    """Evaluate a point as `evaluate` does, with the lobes' weights fitted first: those that lower the loss most while nothing else changes."""
    fits = problem.spread(partial(with_weights_fitted, loss=problem.loss), problem.illuminations(point))
    lights, parts = zip(*fits, strict=True)
    return Iterate(Point(point.materials, list(lights)), list(parts))


def descend(
    problem: JointProblem,
    start: Iterate,
    iterations: int = 10,
    tolerance: float = 1e-4,
    accepted: Callable[[int, Iterate], object] = lambda iteration, iterate: None,
    fixed: Bool[np.ndarray, " 7m"] | bool = False,
) -> Iterate:
    """Lower the loss from `start`, an iterate of this problem, until two steps in a row gain less than `tolerance` of it.

    accepted: called with every point that is taken and the number of its iteration;  fixed: unknowns of the materials that stay as they are
    """
    current, damping, small = start, DAMPING, 0
    for iteration in range(iterations):
        dm, dl, predicted = damped_step(current, damping, fixed)
        trial = fit_weights(problem, moved_point(current.point, dm, dl))
        gained, least = current.loss - trial.loss, tolerance * current.loss
        if gained > 0:
            small = small + 1 if gained < least else 0
        else:
            small += predicted < least
        share = gained / max(predicted, 1e-300)
        damping = max(damping / LESS, LEAST_DAMPING) if share > GOOD else damping if share > BAD else damping * MORE
        if gained > 0:
            current = trial
            accepted(iteration, current)
        if small >= ENOUGH:
            break
    return current


def damped_step(
    at: Iterate, damping: float, fixed: Bool[np.ndarray, " 7m"] | bool = False
) -> tuple[Float[np.ndarray, " 7m"], list[Float[np.ndarray, " l"]], float]:
    """The step at the given Levenberg–Marquardt `damping`, of materials and of lights, and by how much the quadratic model falls with it.

    fixed: unknowns of the materials that stay as they are
    An unknown at a bound stays there if the loss would fall beyond it.  Other unknowns are clipped to their ranges after the step;
    weights are fitted anew instead.  While the step takes a sharpness out of its range, or moves a lobe farther than the quadratic
    model holds, it is solved again with tighter limits (`Bounds.tighten`), at most `TIGHTENINGS` times.
    """
    materials = at.point.materials
    free = ~materials_at_bound(materials, at.of_materials()[1]) & ~np.asarray(fixed)
    bounds = [Bounds(part, light, materials) for part, light in zip(at.parts, at.point.lights, strict=True)]
    for _ in range(TIGHTENINGS):
        dm, dl = at.solved(free, bounds, damping)
        tightened = [bound.tighten(step) for bound, step in zip(bounds, dl, strict=True)]
        if not any(tightened):
            break
    return dm, dl, at.predicted_decrease(dm, dl)
