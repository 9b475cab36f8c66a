"""Run of a solver: fits with reported events and checkpoints, progress, and the final state.

A killed solve resumes and ends in the same bytes.  Every step (the choice of effects, the fit of materials, the
splittings, …) is a deterministic function of the previous state, so a saved state need not be computed again.  The
solve continues from the saved form even without an interruption.  The memory layout of an array can change the order of
a sum, and with it the last bits.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, get_args, get_type_hints

import msgspec
import numpy as np
import torch

from factorlib.checkpoint import Checkpoint
from factorlib.inference.fit.fit import Fit, FitSchedule, fit_problem
from factorlib.inference.model.materials import MaterialErrors, Point
from factorlib.inference.model.normal_errors import NormalErrors, apply_errors
from factorlib.inference.model.problem import JointProblem
from factorlib.light.prior import LightPrior, read_light_prior
from factorlib.results.materials import Decision


class Event(msgspec.Struct, frozen=True):
    """Evaluation of one point.

    Attributes:
        round: Number of the fit.
        phase: Name of the phase.
        iteration: Number of the evaluation in this fit.
        loss: Whitened loss per fitted channel value; 1 means explained to the noise model.
        held_out: Held-out loss, of the paper's solver alone; NaN otherwise.
        lobes: Number of lobes or cells.
    """

    round: int
    phase: str
    iteration: int
    loss: float
    held_out: float
    lobes: int


EventReport = Callable[[Event], None]
Progress = Callable[[float, float, str], None]  # amount done, total amount, and the current activity
# Cost of each phase on data/eames, in evaluations of the first one.
PHASES = {
    "shadows": 9,
    "no shadows": 9,
    "shadows and bounces": 14,
    "background": 9,
    "tone curves": 9,
    "distances": 38,
    "splitting": 36,
    "materials and lights": 70,
    "more observations": 1,
    "prior": 3,
    "lights": 70,
    "suns": 120,
}
TYPICAL_EVALUATIONS = 10  # of a phase


# Factor on the number of observations where materials are given: +0.25 dB on data/eames, +0.27 on the made set of 101.
LIGHT_OBSERVATION_FACTOR = 2


def ignore_event(event: Event) -> None:
    """Ignore an event, as the report of a solve without a listener."""


class SolveState(msgspec.Struct, frozen=True):
    """State of a solve after some of its steps.

    Attributes:
        fit: Fit of the last step.
        materials: Last fit of materials and lights together, to observations with reliable normals; before the prior.
        shadows: Decision on the use of visibility.
        interreflection: Decision on light that surfaces send each other.
        backgrounds: Decision on each light's background; empty if not tried.
        grounds: Decision on the shadows on each light's ground; empty if not tried.
        tone: Decision on each light's tone curves; empty if not tried.
        distances: Decision on each light's distance; empty if not tried.
        splitting: Decision on each splitting of the lights' cells.
        suns: Decision on each light's sun.
        observations: Largest number of a light's observations that materials are fitted to.
        errors: Standard errors of the materials of `fit`; empty before they are estimated.
        light_errors: Errors of normals of the observations that lights are fitted to; empty before these fits.
    """

    fit: Fit
    materials: Fit
    shadows: Decision = Decision(False)
    interreflection: Decision = Decision(False)
    backgrounds: list[Decision] = []
    grounds: list[Decision] = []
    tone: list[Decision] = []
    distances: list[Decision] = []
    splitting: list[Decision] = []
    suns: list[Decision] = []
    observations: int = 0
    errors: MaterialErrors = MaterialErrors()
    light_errors: list[NormalErrors] = []

    @property
    def light_observations(self) -> int:
        """Largest number of a light's observations that it is fitted to with the materials fixed."""
        return LIGHT_OBSERVATION_FACTOR * self.observations

    def with_fit(self, fit: Fit, **decisions: list[Decision]) -> SolveState:
        """Return the state after a step that fitted materials and lights."""
        return msgspec.structs.replace(self, fit=fit, materials=fit, **decisions)

    def effective_problem(self, problem: JointProblem) -> JointProblem:
        """Return the problem under the chosen effects: shadows, interreflection, backgrounds and grounds, or not."""
        widths = [each.accepted * (each.width or 1.0) for each in self.backgrounds]
        problem = problem.with_effects(self.shadows.accepted, self.interreflection.accepted)
        return problem.keep_backgrounds(widths).keep_grounds([each.accepted for each in self.grounds])

    def light_sample(self, problem: JointProblem, seed: int) -> JointProblem:
        """Return the observations that lights are fitted to with the materials fixed, under the chosen effects."""
        sample = self.effective_problem(problem).subsample(self.light_observations, seed)
        return apply_errors(sample, self.light_errors) if self.light_errors else sample


class Solution(SolveState, frozen=True, kw_only=True):
    """Result of a solver: its last state, the answer and all evaluations.

    Attributes:
        point: Materials and lights, in the gauge of `factorlib.inference.model.gauge`.
        history: All evaluations.
        prior: Prior on lights of the fits, and of their standard errors.
    """

    point: Point
    history: list[Event]
    prior: LightPrior


def subset_progress(progress: Progress, subsets: int) -> EventReport:
    """Return a report that converts events of the paper's solver to progress in `subsets` reported subsets."""

    def report(event: Event) -> None:
        """Report the number of subsets done."""
        progress(
            event.round, subsets + 1, f"{event.phase} {event.iteration}: loss {event.loss:.3g}, {event.lobes} lobes"
        )

    return report


def solve_progress(progress: Progress) -> EventReport:
    """Return a report that converts events of the joint solve to progress, in evaluations of the first phase.

    Progress moves with every evaluation.  It never goes back, even if several starts enter a phase several times.
    """
    evaluations = dict.fromkeys(PHASES, 0)
    total = sum(PHASES.values())
    furthest = 0.0

    def report(event: Event) -> None:
        """Report the work done.

        A phase counts as three quarters done after its usual number of evaluations, because there may be more.
        """
        nonlocal furthest
        evaluations[event.phase] += 1
        within = 1 - 0.25 ** (evaluations[event.phase] / TYPICAL_EVALUATIONS)
        cost_before = sum(list(PHASES.values())[: list(PHASES).index(event.phase)])
        furthest = max(furthest, min(cost_before + within * PHASES[event.phase], 0.999 * total))
        progress(furthest, total, event.phase)

    return report


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

    def run_steps(
        self, steps: Mapping[str, Callable[[Any, SolveState], SolveState]], request: Any, state: SolveState
    ) -> SolveState:
        """Return the state after all steps; steps that an earlier run completed are read.

        Args:
            steps: Steps by name, each a function of the request and the state.
            request: Input of the solve that all steps share.
            state: Initial state.
        """
        for name, step in steps.items():
            if name in self._states:
                for event in from_tensors(list[Event], self._states[f"{name}, events"]):
                    self._record(event)
            else:
                event_count = len(self.history)
                new_state = step(request, state)
                self._states |= {f"{name}, events": to_tensors(self.history[event_count:]), name: to_tensors(new_state)}
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

    def enter(self, phase: str) -> None:
        """Report the start of a phase that fits nothing, as an event with the loss of the one before."""
        last = self.history[-1]
        self._record(msgspec.structs.replace(last, phase=phase, round=last.round + 1, iteration=0))

    def _record(self, event: Event) -> None:
        """Remember and report an event."""
        self.history.append(event)
        self.report(event)
