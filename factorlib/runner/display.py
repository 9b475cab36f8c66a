"""Display of a run: lines on standard error.

A terminal receives text alone.  Messages have names of files and texts of parsers, and a dataset may be anyone's:
none of it may move the cursor, set a colour or a title, or ring the bell.
"""

import contextlib
import re
import sys
import textwrap
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Any, TextIO, cast

from factorlib.runner.plan import PlannedStep, Step

MOST_WARNINGS = 5  # lines of warnings at the end of a run
BEAT = 10.0  # seconds of silence after which progress is a line


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
    """Display of a run on standard error, in lines: starts, progress, times, errors, and warnings at the end.

    Attributes:
        left: number of steps left, by stage
        warnings: warnings of steps, which `close` prints; those of a failed step, which no result keeps, `fail` prints
    """

    def __init__(self) -> None:
        self.left: Counter[str] = Counter()
        self.warnings: list[tuple[Step, str]] = []
        self._reported: set[str] = set()  # messages that are printed once
        self._line_time = time.monotonic()

    def plan(self, planned: list[PlannedStep]) -> None:
        """Receive the state of a plan."""
        self.left = Counter(p.step.stage for p in planned if p.status != "current")

    def report(self, text: str) -> None:
        """Print a line."""
        self._line_time = time.monotonic()
        print(printable(text), file=sys.stderr, flush=True)

    def report_once(self, text: str) -> None:
        """Print a line unless it has been printed before."""
        if text not in self._reported:
            self._reported.add(text)
            self.report(text)

    def start(self, step: Step) -> None:
        """Show that the first step of a stage begins."""
        self.report_once(f"{step.stage:<10} {f'{self.left[step.stage]} steps ' if step.item else ''}…")

    def progress(self, step: Step, done: float, total: float, text: str) -> None:
        """Show a running step's progress (`done` of `total`, in any unit) and text, unless a line was just printed."""
        if time.monotonic() - self._line_time >= BEAT:
            share = f"{min(done / total, 1.0):4.0%}" if total else ""
            self.report(f"{step.stage:<10} {step.item:<16} {f'{share} {text}'.strip()}")

    def finish(self, step: Step, seconds: float) -> None:
        """Show that a step is done, after `seconds`."""
        self.report(f"{step.stage:<10} {step.item:<16} {seconds:6.1f} s")

    def fail(self, step: Step, error: str, traceback: str | None) -> None:
        """Print the warnings and the error of a step, with the traceback of a defect of the program."""
        for text in (text for each, text in self.warnings if each == step):
            self.report(f"warning: {step}: {text}")
        self.warnings = [warning for warning in self.warnings if warning[0] != step]
        self.report(f"error: {step}: {error}")
        if traceback:
            self.report(f"  this is a defect of the program, not of your input:\n{traceback}")

    def close(self) -> None:
        """Print the warnings."""
        for line in warning_lines(self.warnings):
            self.report(line)
