"""Levenberg–Marquardt over all materials and lights: damped steps, taken when they lower the loss.

Radiance is linear in the lobes' weights, and its slopes by their places and sharpnesses grow with them: a lobe that takes over
another's energy while it moves is what the step of all unknowns foretells worst.  So of a step the weights are not kept: they are
fitted anew to where the lobes and materials have gone (an embedded point iteration; Jeong et al. 2012, Hong et al. 2017), from the
responses that the next system is made of in any case.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import msgspec
import numpy as np
from jaxtyping import Bool

from factorlib.solve.normal_equations import Loss, System, system
from factorlib.solve.problem import Block
from factorlib.solve.step import damped_step
from factorlib.solve.unknowns import Light, Materials
from factorlib.solve.weights import system_of_fitted

LESS, MORE = 2.5, 3.0  # the damping is divided and multiplied by, after a good and a bad step


class Solution(msgspec.Struct, frozen=True):
    """A point of the joint problem, with its normal equations."""

    materials: Materials
    lights: list[Light]
    systems: list[System]

    @property
    def loss(self) -> float:
        return sum(s.loss for s in self.systems)


class Descent(msgspec.Struct, frozen=True):
    """Stops after `iterations`, or when two steps lower the loss, or promise to where they fail, by less than `tolerance` of itself."""

    iterations: int = 10
    tolerance: float = 1e-4
    damping: float = 1e-3


def evaluated(blocks: Sequence[Block], materials: Materials, lights: Sequence[Light], operator, loss: Loss, map_: Callable) -> Solution:
    """The solution with its systems; `map_` spreads the illuminations, whose order fixes every sum."""
    systems = map_(partial(_system, materials=materials, operator=operator, loss=loss), list(zip(blocks, lights, strict=True)))
    return Solution(materials, list(lights), list(systems))


def _system(pair: tuple[Block, Light], materials: Materials, operator, loss: Loss) -> System:
    return system(*pair, materials, operator, loss)


def fitted(blocks: Sequence[Block], materials: Materials, lights: Sequence[Light], operator, loss: Loss, map_: Callable) -> Solution:
    """As `evaluated`, the lights with the weights that lower the loss most."""
    found = list(map_(partial(_fitted, materials=materials, operator=operator, loss=loss), list(zip(blocks, lights, strict=True))))
    return Solution(materials, [light for light, _ in found], [of_light for _, of_light in found])


def _fitted(pair: tuple[Block, Light], materials: Materials, operator, loss: Loss) -> tuple[Light, System]:
    return system_of_fitted(*pair, materials, operator, loss)


def descend(
    blocks: Sequence[Block],
    start: Solution,
    operator,
    loss: Loss,
    descent: Descent,
    map_: Callable,
    report: Callable[[int, Solution], None] = lambda iteration, solution: None,
    held: Bool[np.ndarray, "7m"] | None = None,
) -> Solution:
    """Lower the loss from `start`; every accepted point is reported.  held: unknowns of the materials that stay as they are."""
    current, damping, idle = start, descent.damping, 0
    for iteration in range(descent.iterations):
        step = damped_step(current.systems, current.materials, current.lights, damping, held)
        materials = Materials.of_vector(current.materials.vector() + step.materials)
        lights = [light.moved(by, current.materials.blur) for light, by in zip(current.lights, step.lights, strict=True)]
        trial = fitted(blocks, materials, lights, operator, loss, map_)
        gained, least = current.loss - trial.loss, descent.tolerance * current.loss
        trust = gained / max(step.promised, 1e-300)
        if gained > 0:
            idle = idle + 1 if gained < least else 0
            current = trial
            report(iteration, current)
        else:
            idle += step.promised < least
        damping = max(damping / LESS, 1e-9) if trust > 0.6 else damping if trust > 0.2 else damping * MORE
        if idle >= 2:
            break
    return current
