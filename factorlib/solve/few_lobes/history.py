"""A run of the solver of few lobes: its options, the events it reports, and the journal from which a stopped run goes on."""

from __future__ import annotations

import msgspec
import numpy as np

from factorlib.model.problem import JointProblem
from factorlib.solve.few_lobes.iterate import Iterate
from factorlib.solve.few_lobes.options import FewLobes
from factorlib.solve.history import Event, Report, Snapshot, unreported, unwatched
from factorlib.solve.resume import Journal


class Run(msgspec.Struct, frozen=True):
    """options: how to solve;  report, snapshot: called at every accepted point;  journal: the parts that are done already."""

    options: FewLobes = FewLobes()
    report: Report = unreported
    snapshot: Snapshot = unwatched
    journal: Journal = msgspec.field(default_factory=Journal)


class Recorder:
    """Appends events to `history` and reports them; `problem` gives the held-out loss."""

    def __init__(self, problem: JointProblem, history: list[Event], run: Run):
        self.problem, self.history, self.run = problem, history, run

    def record(self, round_: int, phase: str, iteration: int, iterate: Iterate) -> float:
        """Record an iterate.  Returns its held-out loss if it ends a round (iteration −1), else NaN."""
        point = iterate.point
        held_out = self.problem.held_out_loss(point) if iteration < 0 else np.nan
        loss = iterate.loss / self.problem.fitted_values
        self.history.append(Event(round_, phase, iteration, loss, held_out, sum(map(len, point.lights))))
        self.run.report(self.history[-1])
        self.run.snapshot(self.history[-1], point)
        return held_out
