"""Run of a solve with checkpoints: each step is computed once, and a killed solve resumes and ends in the same bytes.

Every step (the choice of effects, the fit of materials, the splittings, …) is a deterministic function of the previous
state, so a saved state need not be computed again.  The solve continues from the saved form even without an
interruption.  The memory layout of an array can change the order of a sum, and with it the last bits.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, TypeVar, get_args, get_type_hints

import msgspec
import numpy as np
import torch

from factorlib.checkpoint import Checkpoint
from factorlib.inference.fit import Fit, FitSchedule, fit_problem
from factorlib.inference.history import Event, EventReport, ignore_event
from factorlib.inference.problem import JointProblem
from factorlib.light.prior import LightPrior, read_light_prior

T = TypeVar("T")
Q = TypeVar("Q")


def to_tensors(value: Any) -> Any:
    """Return a structure with structs as dictionaries and arrays as independent tensors."""
    if isinstance(value, msgspec.Struct):
        return {name: to_tensors(getattr(value, name)) for name in value.__struct_fields__}
    if isinstance(value, np.ndarray):
        return torch.from_numpy(np.array(value, order="C"))
    return [to_tensors(item) for item in value] if isinstance(value, list) else value


def from_tensors(type_: Any, value: Any) -> Any:
    """Return the value of a given type from its `to_tensors` form."""
    if isinstance(value, torch.Tensor):
        return value.numpy().copy()
    if isinstance(value, dict):
        hints = get_type_hints(type_)
        return type_(**{name: from_tensors(hints[name], item) for name, item in value.items()})
    return [from_tensors(get_args(type_)[0], item) for item in value] if isinstance(value, list) else value


class FitRunner:
    """Runner of fits under one prior, which saves, reports and remembers states and events.

    Args:
        checkpoint: File of the states; without a file nothing outlives the process (a notebook, a test).
        report: Called at every evaluated point.
        prior: Prior on lights; None for the shipped one.
    """

    def __init__(
        self,
        checkpoint: Checkpoint = Checkpoint(None),
        report: EventReport = ignore_event,
        prior: LightPrior | None = None,
    ):
        self.report = report
        self.prior = prior or read_light_prior()
        self.history = list[Event]()
        self._checkpoint = checkpoint
        self._states = checkpoint.load() or {}

    def run_steps(self, steps: Mapping[str, Callable[[Q, T], T]], asked: Q, state: T) -> T:
        """Return the state after all steps; steps that an earlier run completed are read.

        Args:
            steps: Steps by name, each a function of the question and the state.
            asked: Question.
            state: Initial state.
        """
        for name, step in steps.items():
            if name in self._states:
                for event in from_tensors(list[Event], self._states[f"{name}, events"]):
                    self._record(event)
            else:
                before = len(self.history)
                after = step(asked, state)
                self._states |= {f"{name}, events": to_tensors(self.history[before:]), name: to_tensors(after)}
                self._checkpoint.save(self._states)
            state = from_tensors(type(state), self._states[name])
        return state

    def fit(self, phase: str, problem: JointProblem, start: Fit, schedule: FitSchedule) -> Fit:
        """Fit under the prior on lights, and report every evaluated point as an event of the phase.

        Args:
            phase: Name of the phase.
            problem: Observations and model.
            start: Initial fit.
            schedule: Number of steps.
        """
        number = self.history[-1].round + 1 if self.history else 0
        iteration = 0
        cells = sum(map(len, start.point.lights))

        def tell(loss: float) -> None:
            """Report one evaluated point."""
            nonlocal iteration
            self._record(Event(number, phase, iteration, loss, float("nan"), cells))
            iteration += 1

        return fit_problem(problem, start, self.prior, schedule, tell)

    def fit_and_report(self, phase: str, problem: JointProblem, start: Fit, schedule: FitSchedule) -> Fit:
        """Fit, and report the held-out loss as the end of the phase (iteration −1).

        Args:
            phase: Name of the phase.
            problem: Observations and model.
            start: Initial fit.
            schedule: Number of steps.
        """
        fit = self.fit(phase, problem, start, schedule)
        held_out = problem.held_out_loss(fit.point)
        self._record(msgspec.structs.replace(self.history[-1], iteration=-1, held_out=held_out))
        return fit

    def _record(self, event: Event) -> None:
        """Remember and report an event."""
        self.history.append(event)
        self.report(event)
