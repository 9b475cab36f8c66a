"""What a run of a solver reports, and what it ends with."""

from __future__ import annotations

from collections.abc import Callable

import msgspec
import numpy as np
from jaxtyping import Bool

from factorlib.model.loss import Loss
from factorlib.model.point import Point
from factorlib.model.problem import JointProblem
from factorlib.solve.evidence import Evidence
from factorlib.solve.fit import Fit


class Event(msgspec.Struct, frozen=True):
    """One point that was tried: `loss` per fitted channel value, whitened (1 = explained to the noise model).

    The last event of a part has iteration −1 and says its held-out loss, which is not a number in all others."""

    round: int
    phase: str
    iteration: int
    loss: float
    held_out: float
    lobes: int


Report = Callable[[Event], None]


def unreported(event: Event) -> None:
    """The default: no reports."""


class Solution(msgspec.Struct, frozen=True):
    """The answer of a solver: a point, and what was decided of the model.

    history     every point that was tried;  loss: the loss function that judges held-out observations
    lambertian  materials without specular part
    shadows     whether visibility was used, with its evidence;  interreflection: whether surfaces light each other
    specular    the evidence for each material's specular part, tone: for each light's tone curves; empty where nothing was tried
    splitting   the evidence for each splitting of the lights' cells
    materials   where lights are cells: the fit of the sure observations, whose materials the answer has;  lights: that of all
    """

    point: Point
    history: list[Event]
    loss: Loss
    lambertian: Bool[np.ndarray, " m"]
    shadows: Evidence = Evidence(False)
    interreflection: Evidence = Evidence(False)
    specular: list[Evidence] = []
    tone: list[Evidence] = []
    splitting: list[Evidence] = []
    materials: Fit | None = None
    lights: Fit | None = None

    def shown(self, problem: JointProblem) -> JointProblem:
        """The problem that the answer solves: with shadows and bounces or without, with the last loss."""
        return problem.with_effects(self.shadows.kept, self.interreflection.kept).with_loss(self.loss)
