"""Where a run is shown: bars on a terminal, plain lines elsewhere."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TextIO

from factorlib.runner.display import Display
from factorlib.runner.plan import Step

PATIENCE = 2.0  # seconds that pass without a sign of life


def display_for(stream: TextIO | None = None) -> Display:
    """What fits the stream (default: standard error); bars, and what draws them, are loaded for a terminal only."""
    stream = stream or sys.stderr
    if stream.isatty():
        from factorlib.runner.bars import Bars

        return Bars()
    return Display(stream)


@contextmanager
def shown_if_long(what: str, stream: TextIO | None = None) -> Iterator[Callable[[float, float], None]]:
    """A report (done, total) for work outside the pipeline: shown as a step called `what` once PATIENCE is over."""
    started, step, display = time.monotonic(), Step(what), None

    def report(done: float, total: float) -> None:
        """Of how much is done; nothing is printed for short work."""
        nonlocal display
        if display is None and time.monotonic() - started >= PATIENCE:
            display = display_for(stream)
            display.start(step)
        if display is not None:
            display.progress(step, done, total, "")
            display.tick()

    try:
        yield report
        if display is not None:
            display.finish(step, time.monotonic() - started)
    finally:
        if display is not None:
            display.close()
