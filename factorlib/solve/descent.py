"""Levenberg–Marquardt over all materials and lights: damped steps, taken when they lower the loss."""

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
    """Stops after `iterations`, or when two steps in a row lower the loss by less than `tolerance` of itself."""

    iterations: int = 10
    tolerance: float = 1e-4
    damping: float = 1e-3


def evaluated(blocks: Sequence[Block], materials: Materials, lights: Sequence[Light], operator, loss: Loss, map_: Callable) -> Solution:
    """The solution with its systems; `map_` spreads the illuminations, whose order fixes every sum."""
    systems = map_(partial(_system, materials=materials, operator=operator, loss=loss), list(zip(blocks, lights, strict=True)))
    return Solution(materials, list(lights), list(systems))


def _system(pair: tuple[Block, Light], materials: Materials, operator, loss: Loss) -> System:
    return system(*pair, materials, operator, loss)


def descend(
    blocks: Sequence[Block],
    start: Solution,
    operator,
    loss: Loss,
    descent: Descent,
    map_: Callable,
    report: Callable[[int, Solution], None] = lambda iteration, solution: None,
    matte: Bool[np.ndarray, "m"] | None = None,
) -> Solution:
    """Lower the loss from `start`; every accepted point is reported.  Materials that are `matte` keep what specular part they have."""
    current, damping, idle = start, descent.damping, 0
    for iteration in range(descent.iterations):
        step = damped_step(current.systems, current.materials, current.lights, damping, matte)
        materials = Materials.of_vector(current.materials.vector() + step.materials)
        lights = [light.moved(by, current.materials.blur) for light, by in zip(current.lights, step.lights, strict=True)]
        trial = evaluated(blocks, materials, lights, operator, loss, map_)
        gained = current.loss - trial.loss
        trust = gained / max(step.promised, 1e-300)
        if gained > 0:
            idle = idle + 1 if gained < descent.tolerance * current.loss else 0
            current = trial
            report(iteration, current)
        else:
            idle += damping > 1e6
        damping = max(damping / LESS, 1e-9) if trust > 0.6 else damping if trust > 0.2 else damping * MORE
        if idle >= 2:
            break
    return current
