"""What a run of a solver reports, how far that says it is, and what it ends with."""

from __future__ import annotations

from collections.abc import Callable

import msgspec

from factorlib.inference.fit import Fit
from factorlib.inference.materials import Point
from factorlib.inference.options import Choices
from factorlib.inference.problem import JointProblem
from factorlib.results.materials import Decision


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
Progress = Callable[[float, float, str], None]  # done, of how many, and what it is doing
PHASES = {  # about how many points are tried, and what one costs beside one of the first phase, on data/eames
    "shadows": (13, 1),
    "no shadows": (8, 1),
    "shadows and bounces": (8, 1),
    "tone curves": (6, 1),
    "distances": (24, 1.5),
    "materials and lights": (11, 7),
}
SPLITTING = (7, 9)
LAST = {"lights": (3, 14), "suns": (4, 10)}


def unreported(event: Event) -> None:
    """The default: no reports."""


class Solution(msgspec.Struct, frozen=True):
    """The answer of a solver: a point, and what was decided of the model.

    history     every point that was tried
    shadows     whether visibility was used, with its evidence;  interreflection: whether surfaces light each other
    tone        the evidence for each light's tone curves;  distances: for each light's distance; empty where nothing was tried
    splitting   the evidence for each splitting of the lights' cells
    suns        the evidence for each light's sun
    materials   the fit of the sure observations, whose materials the answer has;  lights: that of all
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

    def shown(self, problem: JointProblem) -> JointProblem:
        """Return the problem that the answer solves: with shadows and bounces, or without."""
        return problem.with_effects(self.shadows.kept, self.interreflection.kept)


def of_subsets(progress: Progress, subsets: int) -> Report:
    """Return the progress of the paper's solver, which reports so many subsets."""

    def report(event: Event) -> None:
        """Say how many of all subsets are done."""
        progress(
            event.round, subsets + 1, f"{event.phase} {event.iteration}: loss {event.loss:.3g}, {event.lobes} lobes"
        )

    return report


def of_parts(progress: Progress, choices: Choices) -> Report:
    """The progress of the joint solve, in points of the first phase.  It moves with every point, and where there are several starts, and a
    phase is entered several times, it does not go back."""
    phases = PHASES | {f"splitting {k + 1}": SPLITTING for k in range(choices.splittings)} | LAST
    costs = {phase: points * cost for phase, (points, cost) in phases.items()}
    tried = dict.fromkeys(phases, 0)
    total = sum(costs.values())
    furthest = 0.0

    def report(event: Event) -> None:
        """Say how much is done: three quarters of a phase after its usual number of points, for there may be more."""
        nonlocal furthest
        tried[event.phase] += 1
        within = 1.0 if event.iteration < 0 else 1 - 0.25 ** (tried[event.phase] / phases[event.phase][0])
        before = sum(costs[phase] for phase in list(phases)[: list(phases).index(event.phase)])
        furthest = max(furthest, min(before + within * costs[event.phase], 0.999 * total))
        progress(furthest, total, f"{event.phase} {event.iteration}: loss {event.loss:.3g}")

    return report
