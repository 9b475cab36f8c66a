"""How far a solve is, from what it reports of its points."""

from __future__ import annotations

from collections.abc import Callable

from factorlib.solve.history import Event, Report
from factorlib.solve.options import Bundle
from factorlib.solve.paper import REPORTS

Progress = Callable[[float, float, str], None]  # done, of how many, and what it is doing


def of_subsets(progress: Progress) -> Report:
    """Of the paper's solver."""
    return lambda event: progress(event.round + 1, REPORTS + 1, f"subset {event.iteration}: loss {event.loss:.3g}")


def of_rounds(progress: Progress, bundle: Bundle, models: int) -> Report:
    """Of the bundle solver; models: how many it chooses from."""
    total, fitted, round_ = models * bundle.rounds + 1, 0, 0  # of the models to choose from, those that are done

    def report(event: Event) -> None:
        """Say how many of all rounds are done."""
        nonlocal fitted, round_
        fitted, round_ = fitted + (event.round < round_), event.round
        of_round = (event.iteration + 1) / bundle.iterations if event.phase == "descent" else 1.0
        done = fitted * bundle.rounds + event.round + min(of_round, 1.0) if event.phase != "polish" else total - 1
        number = event.round if event.phase in ("descent", "round") else event.iteration
        progress(done, total, f"{event.phase} {number}: loss {event.loss:.3g}, {event.lobes} lobes")

    return report
