"""A run of the solver of few lobes: its options, and the events it reports."""

from __future__ import annotations

import msgspec
import numpy as np

from factorlib.model.problem import JointProblem
from factorlib.solve.few_lobes.descent import Iterate
from factorlib.solve.few_lobes.options import FewLobes
from factorlib.solve.history import Event, Report, unreported


class Run(msgspec.Struct, frozen=True):
    """options: how to solve;  report: called at every accepted point."""

    options: FewLobes = FewLobes()
    report: Report = unreported


class Recorder:
    """Appends events to `history` and reports them; `problem` gives the held-out loss."""

    def __init__(self, problem: JointProblem, history: list[Event], run: Run):
        self.problem, self.history, self.run = problem, history, run

    def record(self, round_: int, phase: str, iteration: int, iterate: Iterate) -> None:
        """Record an iterate, with its held-out loss if it ends a round (iteration −1)."""
        held_out = self.problem.held_out_loss(iterate.point) if iteration < 0 else np.nan
        loss = iterate.loss / self.problem.fitted_values
        self.history.append(Event(round_, phase, iteration, loss, held_out, sum(map(len, iterate.point.lights))))
        self.run.report(self.history[-1])
