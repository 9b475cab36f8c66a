"""Levenberg–Marquardt over all materials and lights: damped steps, taken when they lower the loss.

Radiance is linear in the lobes' weights, and its derivatives by axes and sharpnesses are proportional to the weights.  So the step
predicts badly what happens where one lobe takes over the energy of another while it moves.  The weights of a step are therefore not
used: with lobes and materials where the step put them, the weights are fitted anew (an embedded point iteration; Jeong et al. 2012,
Hong et al. 2017).  That costs little, for the next system needs the same responses.
"""

from __future__ import annotations

from collections.abc import Callable

import msgspec
import numpy as np
from jaxtyping import Bool

from factorlib.model.problem import JointProblem
from factorlib.solve.few_lobes.control import Damping, Termination
from factorlib.solve.few_lobes.iterate import Iterate, fit_weights
from factorlib.solve.few_lobes.step import damped_step
from factorlib.solve.few_lobes.unknowns import moved_point

Accepted = Callable[[int, Iterate], None]  # called with the number of an iteration and the accepted iterate


class Descent(msgspec.Struct, frozen=True):
    """When a descent stops: after `iterations`, or after two steps in a row that gain less than `tolerance` of the loss."""

    iterations: int = 10
    tolerance: float = 1e-4


def descend(
    problem: JointProblem,
    start: Iterate,
    descent: Descent,
    accepted: Accepted = lambda iteration, iterate: None,
    fixed: Bool[np.ndarray, " 7m"] | None = None,
) -> Iterate:
    """Lower the loss from `start`, an iterate of this problem; every accepted point is reported.

    fixed: unknowns of the materials that stay as they are
    """
    current, damping, termination = start, Damping(), Termination(descent.tolerance)
    for iteration in range(descent.iterations):
        step = damped_step(current, damping.value, fixed)
        trial = fit_weights(problem, moved_point(current.point, step.materials, step.lights))
        gained = current.loss - trial.loss
        termination = termination.after(gained, step.predicted, current.loss)
        damping = damping.after(gained, step.predicted)
        if gained > 0:
            current = trial
            accepted(iteration, current)
        if termination.reached:
            break
    return current
