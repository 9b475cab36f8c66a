"""Display of a run on standard error: lines, and on a terminal a bar for each stage.

A terminal receives text alone.  Messages have names of files and texts of parsers, and a dataset may be anyone's:
none of it may move the cursor, set a colour or a title, or ring the bell.
"""

import contextlib
import re
import sys
import textwrap
import time
from collections.abc import Iterator, Sequence
from typing import Any, TextIO, cast

from factorlib.runner.plan import PlannedStep, Step

MOST_WARNINGS = 5  # lines of warnings at the end of a run
BEAT = 10.0  # seconds of silence after which progress is a line, away from a terminal


def printable(text: str) -> str:
    r"""Escape every character that is not printable, except for line breaks, as Python's literals do.

    >>> printable("a\x1b[31mb\u202ec\n")
    'a\\x1b[31mb\\u202ec\n'
    """
    return "".join(c if c.isprintable() or c == "\n" else ascii(c)[1:-1] for c in text)


def warning_lines(warnings: Sequence[tuple[Step, str]]) -> list[str]:
    """Format warnings of steps for a person: at most MOST_WARNINGS lines, each of one fault and all that have it.

    Warnings that differ in numbers, paths and the photo's name are one fault.

    >>> warning_lines([(Step("masks", p), f"data/{p}.jpg: is a crop") for p in ("hall", "yard")])
    ['warning: masks/hall: data/hall.jpg: is a crop (and 1 more: yard)']
    """
    groups: dict[str, list[tuple[Step, str]]] = {}
    for step, text in warnings:
        words = re.sub(rf"\S*/\S*|\b{re.escape(step.item)}\b|\d+", "", text)
        groups.setdefault(f"{step.stage}: {words}", []).append((step, text))
    lines = []
    for (step, text), *others in groups.values():
        names = textwrap.shorten(", ".join(dict.fromkeys(each.item for each, _ in others)), 80, placeholder=" …")
        lines.append(f"warning: {step}: {text}" + f" (and {len(others)} more: {names})" * bool(names))
    if (left := len(lines) - MOST_WARNINGS) > 0:
        lines[-left - 1 :] = [f"{left + 1} more warnings: `make status` and the report have all"]
    return lines


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


class Display:
    """Display of a run on standard error: starts, warnings and times, a line each.

    On a terminal a bar for each stage stands below them, with the remaining time that rich estimates.

    Attributes:
        stages: numbers of steps, and of those left, by stage
        warnings: warnings of steps, which `close` prints; those of a failed step, which no result keeps, `fail` prints
    """

    def __init__(self) -> None:
        from rich import progress  # A run with nothing to do does not load it.
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
        self.plain = not stream.isatty()
        self.stages: dict[str, tuple[int, int]] = {}
        self._bars = progress.Progress(
            *columns, console=Console(file=stream), disable=self.plain, speed_estimate_period=600
        )
        self.warnings: list[tuple[Step, str]] = []
        self._rows: dict[str, Any] = {}
        self._running: dict[Step, tuple[float, str]] = {}  # share done, and description
        self._reported: set[str] = set()  # messages that are printed once
        self._line_time = time.monotonic()
        self._bars.start()

    def plan(self, planned: list[PlannedStep]) -> None:
        """Show the state of a plan."""
        self.stages = {}
        for p in planned:
            total, left = self.stages.get(p.step.stage, (0, 0))
            self.stages[p.step.stage] = (total + 1, left + (p.status != "current"))

    def report(self, text: str) -> None:
        """Print a line, above the bars if there are any."""
        self._line_time = time.monotonic()
        self._bars.console.print(printable(text), markup=False, highlight=False, emoji=False, soft_wrap=True)

    def report_once(self, text: str) -> None:
        """Print a line unless it has been printed before."""
        if text not in self._reported:
            self._reported.add(text)
            self.report(text)

    def start(self, step: Step) -> None:
        """Show that a step begins."""
        _, left = self.stages.setdefault(step.stage, (1, 1))
        self._running[step] = (0.0, "")
        if step.stage not in self._rows:
            self._rows[step.stage] = self._bars.add_task(step.stage, count="", words="")
            if self.plain:
                self.report(f"{step.stage:<10} {f'{left} steps ' if step.item else ''}…")
        self._draw(step.stage)

    def progress(self, step: Step, done: float, total: float, text: str) -> None:
        """Show a running step's progress (`done` of `total`, in any unit) and description."""
        share = min(done / total, 1.0) if total else 0.0
        self._running[step] = (share, f"{f'{share:4.0%}' if total else ''} {printable(text)}".strip())
        self._draw(step.stage)
        if self.plain and time.monotonic() - self._line_time >= BEAT:
            self.report(f"{step.stage:<10} {step.item:<16} {self._running[step][1]}")

    def finish(self, step: Step, seconds: float) -> None:
        """Show that a step is done, after `seconds`."""
        total, left = self.stages[step.stage]
        self.stages[step.stage] = (total, max(0, left - 1))  # The plan may already know the result.
        self._running.pop(step)
        self._draw(step.stage)
        if self.plain:
            self.report(f"{step.stage:<10} {step.item:<16} {seconds:6.1f} s")

    def fail(self, step: Step, error: str, traceback: str | None) -> None:
        """Print the warnings and the error of a step, with the traceback of a defect of the program."""
        self._running.pop(step, None)
        for text in (text for each, text in self.warnings if each == step):
            self.report(f"warning: {step}: {text}")
        self.warnings = [warning for warning in self.warnings if warning[0] != step]
        self.report(f"error: {step}: {error}")
        if traceback:
            self.report(f"  this is a defect of the program, not of your input:\n{traceback}")

    def _draw(self, stage: str) -> None:
        """Set the bar of a stage."""
        total, left = self.stages.get(stage, (1, 1))
        running = {step: state for step, state in self._running.items() if step.stage == stage}
        completed = total - left + sum(share for share, _ in running.values())
        words = "; ".join(f"{step.item} {text}".strip() for step, (_, text) in running.items())[:80]
        self._bars.update(
            self._rows[stage], completed=completed, total=total, count=f"{total - left}/{total}", words=words
        )

    def close(self) -> None:
        """Remove the bars, release the terminal, and print the warnings."""
        self._bars.stop()
        for line in warning_lines(self.warnings):
            self.report(line)
