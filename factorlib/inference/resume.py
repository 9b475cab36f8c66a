"""The run of a solve: each step is done once and kept, so that a solve that was killed goes on and ends in the same bytes.

Every step (the choice of effects, the fit of materials, the splittings, …) is a deterministic function of the state before it, so a state that was
saved need not be computed again.  Even without a stop the solve goes on from the saved form: the memory layout of an array can change the order
of a sum, and so the last bits.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, TypeVar, get_args, get_type_hints

import msgspec
import numpy as np
import torch

from factorlib.checkpoint import Checkpoint
from factorlib.inference.fit import Fit, Schedule, fitted
from factorlib.inference.history import Event, Report, unreported
from factorlib.inference.problem import JointProblem
from factorlib.light.prior import LightPrior, read_light_prior

T = TypeVar("T")
Q = TypeVar("Q")


def plain(value: Any) -> Any:
    """Structs as dictionaries, arrays as tensors of their own."""
    if isinstance(value, msgspec.Struct):
        return {name: plain(getattr(value, name)) for name in value.__struct_fields__}
    if isinstance(value, np.ndarray):
        return torch.from_numpy(np.array(value, order="C"))
    return [plain(item) for item in value] if isinstance(value, list) else value


def restored(type_: Any, value: Any) -> Any:
    """The inverse of `plain`."""
    if isinstance(value, torch.Tensor):
        return value.numpy().copy()
    if isinstance(value, dict):
        hints = get_type_hints(type_)
        return type_(**{name: restored(hints[name], item) for name, item in value.items()})
    return [restored(get_args(type_)[0], item) for item in value] if isinstance(value, list) else value


class Run:
    """Fits under one prior, and the states that they lead to: each is kept with its events, which are reported and remembered.

    checkpoint: of no file, it keeps nothing beyond this process (a notebook, a test);  report: called at every point that is tried;  prior: on
    lights; None: the one that is shipped
    """

    def __init__(
        self, checkpoint: Checkpoint = Checkpoint(None), report: Report = unreported, prior: LightPrior | None = None
    ):
        self.report = report
        self.prior = prior or read_light_prior()
        self.history = list[Event]()
        self._checkpoint = checkpoint
        self._kept = checkpoint.load() or {}

    def completed(self, steps: Mapping[str, Callable[[Q, T], T]], asked: Q, state: T) -> T:
        """Return the state after all steps; those that an earlier run has done are not done again."""
        for name, step in steps.items():
            if name in self._kept:
                for event in restored(list[Event], self._kept[f"{name}, events"]):
                    self._happened(event)
            else:
                before = len(self.history)
                after = step(asked, state)
                self._kept |= {f"{name}, events": plain(self.history[before:]), name: plain(after)}
                self._checkpoint.save(self._kept)
            state = restored(type(state), self._kept[name])
        return state

    def fit(self, phase: str, problem: JointProblem, start: Fit, schedule: Schedule) -> Fit:
        """`fitted`, under the prior on lights; every point that is tried is an event of this phase."""
        number = self.history[-1].round + 1 if self.history else 0
        iteration = 0
        cells = sum(map(len, start.point.lights))

        def tell(loss: float) -> None:
            """Report one point."""
            nonlocal iteration
            self._happened(Event(number, phase, iteration, loss, float("nan"), cells))
            iteration += 1

        return fitted(problem, start, self.prior, schedule, tell)

    def judged(self, phase: str, problem: JointProblem, start: Fit, schedule: Schedule) -> Fit:
        """The fit, whose held-out loss is reported as the end of its part (iteration −1)."""
        fit = self.fit(phase, problem, start, schedule)
        held_out = problem.held_out_loss(fit.point)
        self._happened(msgspec.structs.replace(self.history[-1], iteration=-1, held_out=held_out))
        return fit

    def _happened(self, event: Event) -> None:
        self.history.append(event)
        self.report(event)
