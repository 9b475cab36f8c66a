"""What accompanies a solve: its options, who hears of its points, and what is kept of it."""

from __future__ import annotations

from collections.abc import Callable

import msgspec
import numpy as np

from factorlib.model.point import Point
from factorlib.model.problem import JointProblem
from factorlib.solve.iterate import Iterate
from factorlib.solve.options import Bundle
from factorlib.solve.resume import Journal


class Event(msgspec.Struct, frozen=True):
    """One accepted point: `loss` per fitted channel value, whitened (1 = explained to the noise model)."""

    round: int
    phase: str
    iteration: int
    loss: float
    held_out: float
    lobes: int


Report = Callable[[Event], None]
Snapshot = Callable[[Event, Point], None]  # is handed every accepted point itself


def unreported(event: Event) -> None:
    """Nobody asked for reports."""


def unwatched(event: Event, point: Point) -> None:
    """Nobody asked for snapshots."""


class Run(msgspec.Struct, frozen=True):
    """options: how to solve;  report, snapshot: called at every accepted point;  journal: what is done already, and what to keep."""

    options: Bundle = Bundle()
    report: Report = unreported
    snapshot: Snapshot = unwatched
    journal: Journal = msgspec.field(default_factory=Journal)


class Recorder:
    """Appends events to `history` and passes them on; `problem`: its observations and loss give the held-out loss."""

    def __init__(self, problem: JointProblem, history: list[Event], run: Run):
        self.problem, self.history, self.run = problem, history, run

    def record(self, round_: int, phase: str, iteration: int, iterate: Iterate) -> float:
        """The held-out loss of the iterate where it ends a round (iteration −1), NaN on the way there."""
        point = iterate.point
        held_out = self.problem.held_out_loss(point) if iteration < 0 else np.nan
        loss = iterate.loss / self.problem.fitted_values
        self.history.append(Event(round_, phase, iteration, loss, held_out, sum(map(len, point.lights))))
        self.run.report(self.history[-1])
        self.run.snapshot(self.history[-1], point)
        return held_out
