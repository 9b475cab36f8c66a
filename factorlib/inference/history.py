"""Events, progress and final state of a solver's run."""

from __future__ import annotations

from collections.abc import Callable

import msgspec

from factorlib.inference.fit import Fit
from factorlib.inference.materials import Point
from factorlib.inference.options import SolveOptions
from factorlib.inference.problem import JointProblem
from factorlib.results.materials import Decision


class Event(msgspec.Struct, frozen=True):
    """Evaluation of one point, or the end of a phase.

    The last event of a phase has iteration −1 and states the held-out loss, which is NaN in all others.

    Attributes:
        round: Number of the fit.
        phase: Name of the phase.
        iteration: Number of the evaluation in this fit.
        loss: Whitened loss per fitted channel value; 1 means explained to the noise model.
        held_out: Held-out loss.
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
# Typical number of evaluations of each phase, and the cost of one relative to the first phase's, on data/eames.
PHASES = {
    "shadows": (13, 1),
    "no shadows": (8, 1),
    "shadows and bounces": (8, 1),
    "tone curves": (6, 1),
    "distances": (24, 1.5),
    "materials and lights": (11, 7),
}
SPLITTING = (7, 9)
LAST = {"lights": (3, 14), "suns": (4, 10)}


def ignore_event(event: Event) -> None:
    """Ignore an event."""


class Solution(msgspec.Struct, frozen=True):
    """Result of a solver: a point and the model choices.

    Attributes:
        point: Materials and lights, in the gauge of `factorlib.inference.gauge`.
        history: All evaluations.
        materials: Fit of the observations with reliable normals; the answer has its materials.
        lights: Fit of all observations.
        shadows: Decision on the use of visibility.
        interreflection: Decision on light that surfaces send each other.
        tone: Decision on each light's tone curves; empty if not tried.
        distances: Decision on each light's distance; empty if not tried.
        splitting: Decision on each splitting of the lights' cells.
        suns: Decision on each light's sun.
    """

    point: Point
    history: list[Event]
    materials: Fit
    lights: Fit
    shadows: Decision = Decision(False)
    interreflection: Decision = Decision(False)
    tone: list[Decision] = []
    distances: list[Decision] = []
    splitting: list[Decision] = []
    suns: list[Decision] = []

    def effective_problem(self, problem: JointProblem) -> JointProblem:
        """Return the problem that the answer solves: with or without shadows and interreflection."""
        return problem.with_effects(self.shadows.kept, self.interreflection.kept)


def subset_progress(progress: Progress, subsets: int) -> EventReport:
    """Return a report that converts events of the paper's solver to progress in `subsets` reported subsets."""

    def report(event: Event) -> None:
        """Report the number of subsets done."""
        progress(
            event.round, subsets + 1, f"{event.phase} {event.iteration}: loss {event.loss:.3g}, {event.lobes} lobes"
        )

    return report


def solve_progress(progress: Progress, choices: SolveOptions) -> EventReport:
    """Return a report that converts events of the joint solve to progress, in evaluations of the first phase.

    Progress moves with every evaluation.  It never goes back, even if several starts enter a phase several times.
    """
    phases = PHASES | {f"splitting {k + 1}": SPLITTING for k in range(choices.splittings)} | LAST
    costs = {phase: points * cost for phase, (points, cost) in phases.items()}
    tried = dict.fromkeys(phases, 0)
    total = sum(costs.values())
    furthest = 0.0

    def report(event: Event) -> None:
        """Report the work done.

        A phase counts as three quarters done after its usual number of evaluations, because there may be more.
        """
        nonlocal furthest
        tried[event.phase] += 1
        within = 1.0 if event.iteration < 0 else 1 - 0.25 ** (tried[event.phase] / phases[event.phase][0])
        before = sum(costs[phase] for phase in list(phases)[: list(phases).index(event.phase)])
        furthest = max(furthest, min(before + within * costs[event.phase], 0.999 * total))
        progress(furthest, total, f"{event.phase} {event.iteration}: loss {event.loss:.3g}")

    return report
