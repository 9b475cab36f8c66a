"""A run as a user sees it: plain lines, or on a terminal a bar for each stage; a long step always shows life.

A terminal is shown text alone.  Names of files and words of parsers stand in messages, and a data set may come from
anywhere: none of it may move the cursor, set a colour or a title, or ring the bell.
"""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Iterator
from typing import Any, TextIO

from factorlib.runner.plan import Planned, Step

BEAT = 10.0  # seconds between two plain lines about the same step


def printable(text: str) -> str:
    r"""Replace every character that prints nothing, but for ends of lines, by the form that Python's literals have.

    >>> printable("a\x1b[31mb\u202ec\n")
    'a\\x1b[31mb\\u202ec\n'
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
    with contextlib.redirect_stdout(Plain(sys.stdout)), contextlib.redirect_stderr(Plain(sys.stderr)):
        yield


class Display:
    """Lines on standard error: what starts, what it warns of, how long it took.

    On a terminal a bar for each stage stands below them, with the time that rich expects it to take still.
    """

    def __init__(self) -> None:
        self.stages: dict[str, list[int]] = {}  # how many steps each has, and how many of them are left
        self.running: dict[
            Step, list
        ] = {}  # when it began and was last heard of, which share of it is done, what it does
        self._told: dict[str | Step, None] = {}  # stages that have begun, warnings, and steps that wait
        self._bars: Any = None
        self._rows: dict[str, Any] = {}
        if sys.stderr.isatty():
            self._bars = _bars()
            self._bars.start()

    def plan(self, planned: list[Planned]) -> None:
        """Take over the state of the plan as it is now."""
        self.stages = {p.step.stage: [0, 0] for p in planned}
        for p in planned:
            self.stages[p.step.stage][0] += 1
            self.stages[p.step.stage][1] += p.status != "current"

    def say(self, text: str) -> None:
        """Print a line, above the bars where there are any."""
        if self._bars:
            self._bars.console.print(printable(text), markup=False, highlight=False, soft_wrap=True)
        else:
            print(printable(text), file=sys.stderr, flush=True)

    def _line(self, step: Step, text: str) -> None:
        if not self._bars:
            self.say(f"{step.stage:<10} {text}".rstrip())

    def _first(self, what: str | Step) -> bool:
        first = what not in self._told
        self._told[what] = None
        return first

    def start(self, step: Step) -> None:
        """Show that a step begins, of a stage the first only."""
        self.running[step] = [time.monotonic(), time.monotonic(), 0.0, ""]
        _, left = self.stages.setdefault(step.stage, [1, 1])
        if self._first(step.stage):
            kind = "photo" if step.photo else "recipe"
            self._line(step, "…" if step.of is None else f"{left} {kind}{'s' * (left > 1)} …")

    def waits(self, step: Step) -> None:
        """Say once that a step waits for another run to make its result."""
        if self._first(step):
            self.say(f"{step}: waiting: another run is making it")

    def progress(self, step: Step, done: float, total: float, text: str) -> None:
        """Note a running step's progress (`done` of `total`, in its own unit) and what it does; `tick` shows it."""
        share = min(done / total, 1.0) if total else 0.0
        self.running[step][2:] = share, f"{f'{share:4.0%}' if total else ''} {printable(text)}".strip()

    def tick(self) -> None:
        """Show life: draw the bars anew, or print a line for every step that has been silent for BEAT seconds."""
        now = time.monotonic()
        for step, (began, spoke, _, words) in self.running.items():
            if not self._bars and now - spoke >= BEAT:
                self.running[step][1] = now
                self._line(step, f"{step.of or '':<16} {now - began:6.0f} s  {words}")
        for stage in (stage for stage in self._told if self._bars and stage in self.stages):
            if stage not in self._rows:
                self._rows[stage] = self._bars.add_task(stage, count="", words="")
            total, left = self.stages[stage]
            live = {step: (share, words) for step, (_, _, share, words) in self.running.items() if step.stage == stage}
            words = "; ".join(f"{step.of or ''} {words}".strip() for step, (_, words) in live.items())
            done = total - left + sum(share for share, _ in live.values())
            counted = {"completed": done, "total": total, "count": f"{total - left}/{total}", "words": words[:80]}
            self._bars.update(self._rows[stage], **counted)

    def warn(self, step: Step, text: str) -> None:
        """Print a warning; one that was printed before is left out."""
        if self._first(f"warning: {text}"):
            self.say(f"warning: {step}: {text}")

    def finish(self, step: Step, seconds: float) -> None:
        """Show that a step is done, after `seconds`."""
        self.stages[step.stage][1] = max(0, self.stages[step.stage][1] - 1)  # a plan may know already that it is made
        self.running.pop(step, None)
        self._line(step, f"{step.of or '':<16} {seconds:6.1f} s")

    def fail(self, step: Step, error: str, traceback: str | None) -> None:
        """Say with which error a step ended; `traceback` names the file with details of a defect of the program."""
        self.running.pop(step, None)
        self.say(f"error: {step}: {error}")
        if traceback:
            self.say(f"  this is a defect of the program, not of your input; details: {traceback}")

    def close(self) -> None:
        """Draw the bars a last time and give the terminal back."""
        if self._bars:
            self.tick()
            self._bars.stop()


def _bars() -> Any:
    """Return rich's bars, which are loaded for a terminal only."""
    from rich import progress
    from rich.console import Console

    stream = sys.stderr.stream if isinstance(sys.stderr, Plain) else sys.stderr  # rich moves the cursor itself
    stage, words = (
        progress.TextColumn(f"{{task.{text}}}", markup=False) for text in ("description:<10", "fields[words]")
    )
    count = progress.TextColumn("{task.fields[count]:>7}")
    times = progress.TimeElapsedColumn(), progress.TimeRemainingColumn()
    columns = (progress.SpinnerColumn(), stage, progress.BarColumn(24), count, *times, words)
    return progress.Progress(*columns, console=Console(file=stream), speed_estimate_period=600)
