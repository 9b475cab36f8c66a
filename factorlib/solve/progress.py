"""How far a solve is, from what it reports of its points."""

from __future__ import annotations

from collections.abc import Callable

from factorlib.solve.history import Event, Report
from factorlib.solve.options import Choices
from factorlib.solve.paper import REPORTS

Progress = Callable[[float, float, str], None]  # done, of how many, and what it is doing
PHASES = (
    "no shadows",
    "shadows",
    "shadows and bounces",
    "tone curves",
    "materials and lights",
)  # then splittings, and lights
POINTS = 30  # of a phase: about as many as are tried


def of_subsets(progress: Progress) -> Report:
    """The progress of the paper's solver."""
    return lambda event: progress(event.round + 1, REPORTS + 1, f"subset {event.iteration}: loss {event.loss:.3g}")


def of_rounds(progress: Progress, rounds: int) -> Report:
    """The progress of the solver of few lobes, which takes at most so many rounds."""

    def report(event: Event) -> None:
        """Say how many of all rounds are done."""
        done = event.round if event.phase in ("descent", "round") else rounds
        progress(done, rounds + 1, f"{event.phase} {event.iteration}: loss {event.loss:.3g}, {event.lobes} lobes")

    return report


def of_parts(progress: Progress, choices: Choices) -> Report:
    """The progress of the joint solve, which never goes back: where there are several starts, a phase is entered several times."""
    total, furthest = len(PHASES) + choices.splittings + 1, 0.0

    def report(event: Event) -> None:
        """Say how many of all phases are done."""
        nonlocal furthest
        splitting = event.phase.removeprefix("splitting ")
        phase = (
            PHASES.index(event.phase)
            if event.phase in PHASES
            else len(PHASES) + int(splitting) - 1
            if splitting.isdigit()
            else total - 1
        )
        within = 1.0 if event.iteration < 0 else min(event.iteration / POINTS, 1.0)
        furthest = min(max(furthest, phase + within), total - 0.01)
        progress(furthest, total, f"{event.phase} {event.iteration}: loss {event.loss:.3g}")

    return report
