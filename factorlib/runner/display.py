"""What a user sees of a run: plain lines, or on a terminal a bar for each stage; a long step always shows life.

A terminal is shown text alone.  Names of files and words of parsers stand in messages, and a data set may come from
anywhere: none of it may move the cursor, set a colour or a title, or ring the bell.
"""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any, TextIO

from factorlib.runner.plan import Planned, Step

BEAT = 10.0  # seconds between two plain lines about the same step
PATIENCE = 2.0  # seconds of work outside the pipeline that pass without a sign of life


def printable(text: str) -> str:
    """`text` with every character that prints nothing, but for ends of lines, in the form that Python's literals have.

    >>> printable("a\\x1b[31mb\\u202ec\\n")
    'a\\\\x1b[31mb\\\\u202ec\\n'
    """
    return "".join(c if c.isprintable() or c == "\n" else ascii(c)[1:-1] for c in text)


class Plain:
    """A stream that writes printable text to another, which has all else."""

    def __init__(self, stream: TextIO):
        self.stream = stream

    def write(self, text: str) -> int:
        """Write text; a stream of text takes no bytes."""
        if not isinstance(text, str):
            raise TypeError(f"write() argument must be str, not {type(text).__name__}")
        return self.stream.write(printable(text))

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)


@contextlib.contextmanager
def plain_streams() -> Iterator[None]:
    """Within, standard output and standard error are plain."""
    before = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = map(Plain, before)
    try:
        yield
    finally:
        sys.stdout, sys.stderr = before


class Display:
    """Plain lines: what starts, what it warns of, how long it took."""

    def __init__(self, stream: TextIO | None = None):
        self.stream = stream or sys.stderr
        self.totals: dict[str, int] = {}
        self.left: dict[str, int] = {}
        self.shares: dict[Step, float] = {}  # of each running step, how much is done
        self._said: set[str | Step] = set()  # warnings, and steps that wait
        self._begun: set[str] = set()
        self._spoke: dict[Step, float] = {}
        self._started: dict[Step, float] = {}
        self._words: dict[Step, str] = {}

    def plan(self, planned: list[Planned]) -> None:
        """Take over the state of the plan as it is now."""
        self.totals, self.left = {}, {}
        for p in planned:
            self.totals[p.step.stage] = self.totals.get(p.step.stage, 0) + 1
            self.left[p.step.stage] = self.left.get(p.step.stage, 0) + (p.status != "current")

    def say(self, text: str) -> None:
        """Print a line."""
        print(printable(text), file=self.stream, flush=True)

    def start(self, step: Step) -> None:
        """A step begins; printed for the first step of a stage only."""
        self._started[step] = self._spoke[step] = time.monotonic()
        self.shares[step] = 0.0
        if step.stage not in self._begun:
            self._begun.add(step.stage)
            left = self.left.get(step.stage, 1)
            items = f"{left} {'photo' if step.photo else 'recipe'}{'s' * (left > 1)} …"
            self.line(step.stage, "…" if step.of is None else items)

    def line(self, stage: str, text: str) -> None:
        """Print how far a stage is."""
        self.say(f"{stage:<10} {text}".rstrip())

    def waits(self, step: Step) -> None:
        """A step waits for another run to make its result; printed once."""
        if step not in self._said:
            self._said.add(step)
            self.say(f"{step}: waiting: another run is making it")

    def progress(self, step: Step, done: float, total: float, text: str) -> None:
        """Note how far a running step is (`done` of `total`, in the step's own unit) and what it does; `tick` shows it."""
        self.shares[step] = min(done / total, 1.0) if total else 0.0
        self._words[step] = f"{f'{done / total:4.0%}' if total else ''} {printable(text)}".strip()

    def tick(self) -> None:
        """Show life: print a line for every step that has been silent for BEAT seconds."""
        now = time.monotonic()
        for step, spoke in self._spoke.items():
            if now - spoke >= BEAT:
                self._spoke[step] = now
                seconds = now - self._started[step]
                self.line(step.stage, f"{step.of or '':<16} {seconds:6.0f} s  {self._words.get(step, '')}")

    def warn(self, step: Step, text: str) -> None:
        """Print a warning; one that was printed before is left out."""
        if text not in self._said:
            self._said.add(text)
            self.say(f"warning: {step}: {text}")

    def finish(self, step: Step, seconds: float) -> None:
        """A step is done, after `seconds`."""
        self.left[step.stage] = self.left.get(step.stage, 1) - 1
        self._end(step)
        self.line(step.stage, f"{step.of or '':<16} {seconds:6.1f} s")

    def fail(self, step: Step, error: str, traceback: str | None) -> None:
        """A step ended with an error; `traceback` names the file with details of a defect of the program."""
        self._end(step)
        self.say(f"error: {step}: {error}")
        if traceback:
            self.say(f"  this is a defect of the program, not of your input; details: {traceback}")

    def _end(self, step: Step) -> None:
        for table in (self._spoke, self._words, self.shares):
            table.pop(step, None)

    def close(self) -> None:
        """Nothing more will be shown."""


class Bars(Display):
    """On a terminal a bar for each stage that runs, warnings and errors above them; running steps count by their share."""

    def __init__(self, console: Any = None):
        from rich import progress
        from rich.console import Console

        super().__init__()
        stream = sys.stderr.stream if isinstance(sys.stderr, Plain) else sys.stderr  # rich moves the cursor itself
        columns = [
            progress.SpinnerColumn(),
            progress.TextColumn("{task.description:<10}"),
            progress.BarColumn(24),
            progress.TextColumn("{task.fields[count]:>7}"),
            progress.TimeElapsedColumn(),
            progress.TextColumn("{task.fields[words]}", markup=False),
        ]
        self.bars = progress.Progress(*columns, console=console or Console(file=stream))
        self._rows: dict[str, int] = {}
        self.bars.start()

    def say(self, text: str) -> None:
        """Print a line above the bars."""
        self.bars.console.print(printable(text), markup=False, highlight=False, soft_wrap=True)

    def line(self, stage: str, text: str) -> None:
        """Show it by the stage's bar."""
        self.tick()

    def tick(self) -> None:
        """Draw every bar anew."""
        for stage in self._begun:
            if stage not in self._rows:
                self._rows[stage] = self.bars.add_task(stage, total=1.0, count="", words="")
            total, left = self.totals.get(stage, 1), self.left.get(stage, 1)
            running = {step: share for step, share in self.shares.items() if step.stage == stage}
            words = "; ".join(f"{step.of or ''} {self._words.get(step, '')}".strip() for step in running)
            done, count = total - left + sum(running.values()), f"{total - left}/{total}"
            self.bars.update(self._rows[stage], completed=done, total=total, count=count, words=words[:80])
            if left == 0:
                self.bars.stop_task(self._rows[stage])

    def close(self) -> None:
        """Draw the bars a last time and give the terminal back."""
        self.tick()
        self.bars.stop()


def display_for(stream: TextIO | None = None) -> Display:
    """What fits the stream (default: standard error); bars, and what draws them, are loaded for a terminal only."""
    stream = stream or sys.stderr
    return Bars() if stream.isatty() else Display(stream)


@contextlib.contextmanager
def shown_if_long(what: str, stream: TextIO | None = None) -> Iterator[Callable[[float, float], None]]:
    """A report (done, total) for work outside the pipeline: shown as a step called `what` once PATIENCE is over."""
    started, step, display = time.monotonic(), Step(what), None

    def report(done: float, total: float) -> None:
        """Note how much is done; nothing is printed for short work."""
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
