"""Iterates of the descent: a point of a problem, and the normal equations there."""

from __future__ import annotations

from functools import partial

import msgspec

from factorlib.model.point import Point
from factorlib.model.problem import JointProblem
from factorlib.solve.few_lobes.arrow import ArrowSystem
from factorlib.solve.few_lobes.normal_equations import normal_equations
from factorlib.solve.few_lobes.weights import fitted_illumination


class Iterate(msgspec.Struct, frozen=True):
    """A point, and the system of a problem there."""

    point: Point
    system: ArrowSystem

    @property
    def loss(self) -> float:
        """The loss of the point: robust losses of what is fitted, and priors."""
        return self.system.loss


def evaluate(problem: JointProblem, point: Point) -> Iterate:
    """The point with its system."""
    parts = problem.spread(partial(normal_equations, loss=problem.loss), problem.illuminations(point))
    return Iterate(point, ArrowSystem(list(parts), 7 * len(point.materials)))


def fit_weights(problem: JointProblem, point: Point) -> Iterate:
    """As `evaluate`, with the lobes' weights fitted first: those that lower the loss most while nothing else changes."""
    found = list(problem.spread(partial(fitted_illumination, loss=problem.loss), problem.illuminations(point)))
    system = ArrowSystem([one.equations for one in found], 7 * len(point.materials))
    return Iterate(Point(point.materials, [one.light for one in found]), system)
