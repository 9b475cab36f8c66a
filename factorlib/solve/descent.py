"""Levenberg–Marquardt over all materials and lights: damped steps, taken when they lower the loss.

Radiance is linear in the lobes' weights, and its slopes by their places and sharpnesses grow with them: a lobe that takes over
another's energy while it moves is what the step of all unknowns predicts worst.  So of a step the weights are not kept: they are
fitted anew to where the lobes and materials have gone (an embedded point iteration; Jeong et al. 2012, Hong et al. 2017), from the
responses that the next system is made of in any case.
"""

from __future__ import annotations

from collections.abc import Callable

import msgspec
import numpy as np
from jaxtyping import Bool

from factorlib.model.problem import JointProblem
from factorlib.solve.control import Damping, Termination
from factorlib.solve.iterate import Iterate, fit_weights
from factorlib.solve.step import damped_step

Accepted = Callable[[int, Iterate], None]  # is handed the number of an iteration and the iterate that it led to


class Descent(msgspec.Struct, frozen=True):
    """Stops after `iterations`, or when two steps in a row gain less than `tolerance` of the loss."""

    iterations: int = 10
    tolerance: float = 1e-4


def descend(
    problem: JointProblem,
    start: Iterate,
    descent: Descent,
    accepted: Accepted = lambda iteration, iterate: None,
    fixed: Bool[np.ndarray, "7m"] | None = None,
) -> Iterate:
    """Lower the loss from `start`, an iterate of this problem; every accepted point is reported.

    fixed: unknowns of the materials that stay as they are
    """
    current, damping, termination = start, Damping(), Termination(descent.tolerance)
    for iteration in range(descent.iterations):
        step = damped_step(current, damping.value, fixed)
        trial = fit_weights(problem, current.point.moved(step.materials, step.lights))
        gained = current.loss - trial.loss
        termination = termination.after(gained, step.predicted, current.loss)
        damping = damping.after(gained, step.predicted)
        if gained > 0:
            current = trial
            accepted(iteration, current)
        if termination.reached:
            break
    return current
