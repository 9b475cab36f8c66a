"""Display of a run on standard error: plain lines, or on a terminal a bar for each stage.

A terminal receives text alone.  Messages have names of files and texts of parsers, and a dataset may be anyone's:
none of it may move the cursor, set a colour or a title, or ring the bell.
"""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, TextIO, cast

from factorlib.runner.plan import Planned, Step

BEAT = 10.0  # seconds between two plain lines about the same step


def printable(text: str) -> str:
    r"""Escape every character that is not printable, except for line breaks, as Python's literals do.

    >>> printable("a\x1b[31mb\u202ec\n")
    'a\\x1b[31mb\\u202ec\n'
    """
    return "".join(c if c.isprintable() or c == "\n" else ascii(c)[1:-1] for c in text)


class PrintableStream:
    """Stream that writes printable text to another, which has all other attributes."""

    def __init__(self, stream: TextIO):
        self.stream = stream

    def write(self, text: str) -> int:
        """Write text; TypeError for bytes."""
        if not isinstance(text, str):
            raise TypeError(f"write() argument must be str, not {type(text).__name__}")
        return self.stream.write(printable(text))

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)


@contextlib.contextmanager
def printable_streams() -> Iterator[None]:
    """Make standard output and standard error printable inside."""
    streams = [cast(TextIO, PrintableStream(stream)) for stream in (sys.stdout, sys.stderr)]
    with contextlib.redirect_stdout(streams[0]), contextlib.redirect_stderr(streams[1]):
        yield


@dataclass
class _Progress:
    """Progress of a running step: times of its start and its last line, share done, and a description."""

    started: float = field(default_factory=time.monotonic)
    reported: float = field(default_factory=time.monotonic)
    share: float = 0.0
    words: str = ""


class Display:
    """Lines on standard error: starts, warnings, times.

    On a terminal a bar for each stage stands below them, with the remaining time that rich estimates.

    Attributes:
        stages: numbers of steps, and of those left, by stage
    """

    def __init__(self) -> None:
        self.stages: dict[str, tuple[int, int]] = {}
        self._running: dict[Step, _Progress] = {}
        self._reported: dict[str, None] = {}  # started stages, in order, and messages that are printed once
        self._bars: Any = _bars() if sys.stderr.isatty() else None
        self._rows: dict[str, Any] = {}
        if self._bars:
            self._bars.start()

    def plan(self, planned: list[Planned]) -> None:
        """Show the state of a plan."""
        self.stages = {}
        for p in planned:
            total, left = self.stages.get(p.step.stage, (0, 0))
            self.stages[p.step.stage] = (total + 1, left + (p.status != "current"))

    def report(self, text: str) -> None:
        """Print a line, above the bars if there are any."""
        if self._bars:
            self._bars.console.print(printable(text), markup=False, highlight=False, soft_wrap=True)
        else:
            print(printable(text), file=sys.stderr, flush=True)

    def _line(self, step: Step, text: str) -> None:
        if not self._bars:
            self.report(f"{step.stage:<10} {text}".rstrip())

    def _is_new(self, message: str) -> bool:
        before = len(self._reported)
        self._reported[message] = None
        return len(self._reported) > before

    def start(self, step: Step) -> None:
        """Show that a step begins; a line is printed for the first of a stage."""
        self._running[step] = _Progress()
        _, left = self.stages.setdefault(step.stage, (1, 1))
        if self._is_new(step.stage):
            kind = "photo" if step.photo else "recipe"
            self._line(step, f"{left} {kind}{'s' * (left > 1)} …" if step.item else "…")

    def wait(self, step: Step) -> None:
        """Print once that a step waits for another run to make its result."""
        if self._is_new(f"waiting: {step}"):
            self.report(f"{step}: waiting: another run is making it")

    def progress(self, step: Step, done: float, total: float, text: str) -> None:
        """Set a running step's progress (`done` of `total`, in any unit) and description; `tick` shows it."""
        progress = self._running[step]
        progress.share = min(done / total, 1.0) if total else 0.0
        progress.words = f"{f'{progress.share:4.0%}' if total else ''} {printable(text)}".strip()

    def tick(self) -> None:
        """Draw the bars again, or print a line for every step that has been silent for BEAT seconds."""
        now = time.monotonic()
        for step, progress in self._running.items():
            if not self._bars and now - progress.reported >= BEAT:
                progress.reported = now
                self._line(step, f"{step.item:<16} {now - progress.started:6.0f} s  {progress.words}")
        for stage in (stage for stage in self._reported if self._bars and stage in self.stages):
            if stage not in self._rows:
                self._rows[stage] = self._bars.add_task(stage, count="", words="")
            total, left = self.stages[stage]
            running = {step: progress for step, progress in self._running.items() if step.stage == stage}
            words = "; ".join(f"{step.item} {progress.words}".strip() for step, progress in running.items())
            done = total - left + sum(progress.share for progress in running.values())
            columns = {"completed": done, "total": total, "count": f"{total - left}/{total}", "words": words[:80]}
            self._bars.update(self._rows[stage], **columns)

    def warn(self, step: Step, text: str) -> None:
        """Print a warning, once for each text."""
        if self._is_new(f"warning: {text}"):
            self.report(f"warning: {step}: {text}")

    def finish(self, step: Step, seconds: float) -> None:
        """Show that a step is done, after `seconds`."""
        total, left = self.stages[step.stage]
        self.stages[step.stage] = (total, max(0, left - 1))  # The plan may already know the result.
        self._running.pop(step, None)
        self._line(step, f"{step.item:<16} {seconds:6.1f} s")

    def fail(self, step: Step, error: str, traceback: str | None) -> None:
        """Print the error of a step; `traceback` names the file with details of a defect of the program."""
        self._running.pop(step, None)
        self.report(f"error: {step}: {error}")
        if traceback:
            self.report(f"  this is a defect of the program, not of your input; details: {traceback}")

    def close(self) -> None:
        """Draw the bars a last time and release the terminal."""
        if self._bars:
            self.tick()
            self._bars.stop()


def _bars() -> Any:
    """Return rich's progress bars; rich is loaded for a terminal only."""
    from rich import progress
    from rich.console import Console

    stream = sys.stderr.stream if isinstance(sys.stderr, PrintableStream) else sys.stderr  # rich moves the cursor
    columns = (
        progress.SpinnerColumn(),
        progress.TextColumn("{task.description:<10}", markup=False),
        progress.BarColumn(24),
        progress.TextColumn("{task.fields[count]:>7}"),
        progress.TimeElapsedColumn(),
        progress.TimeRemainingColumn(),
        progress.TextColumn("{task.fields[words]}", markup=False),
    )
    return progress.Progress(*columns, console=Console(file=stream), speed_estimate_period=600)
