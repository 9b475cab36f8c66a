"""What a user sees of a run: plain lines, or on a terminal a bar for each stage; a long step always shows life.

A terminal is shown text alone.  Names of files and words of parsers stand in messages, and a data set may come from
anywhere: none of it may move the cursor, set a colour or a title, or ring the bell.
"""

from __future__ import annotations

import contextlib
import math
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, TextIO

from factorlib.runner.plan import Planned, Step

BEAT = 10.0  # seconds between two plain lines about the same step


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
    with contextlib.redirect_stdout(Plain(sys.stdout)), contextlib.redirect_stderr(Plain(sys.stderr)):
        yield


@dataclass
class Live:
    """A step that runs: when it began and was last heard of, which share of it is done, and what it does."""

    started: float
    spoke: float
    share: float = 0.0
    words: str = ""


class Display:
    """Plain lines: what starts, what it warns of, how long it took."""

    def __init__(self) -> None:
        self.stages: dict[str, list[int]] = {}  # how many steps each has, and how many of them are left
        self.usual: dict[str, tuple[float, int]] = {}  # by stage: seconds a step took before, on how many cores
        self.cores = 1
        self.running: dict[Step, Live] = {}
        self._told: dict[str | Step, None] = {}  # stages that have begun, warnings, and steps that wait

    def plan(self, planned: list[Planned]) -> None:
        """Take over the state of the plan as it is now."""
        self.stages = {p.step.stage: [0, 0] for p in planned}
        for p in planned:
            self.stages[p.step.stage][0] += 1
            self.stages[p.step.stage][1] += p.status != "current"

    def seconds_left(self) -> float | None:
        """How long all that is left takes, if each stage takes as long as before; None where one was never run."""
        left, now = {stage: count for stage, (_, count) in self.stages.items() if count}, time.monotonic()
        if not left.keys() | {step.stage for step in self.running} <= self.usual.keys():
            return None
        work = sum(count * math.prod(self.usual[stage]) for stage, count in left.items())
        for step, live in self.running.items():
            seconds, cores = self.usual[step.stage]
            work -= cores * min(now - live.started, seconds)
        return max(work, 0.0) / self.cores

    def say(self, text: str) -> None:
        """Print a line."""
        print(printable(text), file=sys.stderr, flush=True)

    def line(self, stage: str, text: str) -> None:
        """Print how far a stage is."""
        self.say(f"{stage:<10} {text}".rstrip())

    def _first(self, what: str | Step) -> bool:
        first = what not in self._told
        self._told[what] = None
        return first

    def start(self, step: Step) -> None:
        """A step begins; printed for the first step of a stage only."""
        self.running[step] = Live(time.monotonic(), time.monotonic())
        _, left = self.stages.setdefault(step.stage, [1, 1])
        if self._first(step.stage):
            kind = "photo" if step.photo else "recipe"
            self.line(step.stage, "…" if step.of is None else f"{left} {kind}{'s' * (left > 1)} …")

    def waits(self, step: Step) -> None:
        """A step waits for another run to make its result; printed once."""
        if self._first(step):
            self.say(f"{step}: waiting: another run is making it")

    def progress(self, step: Step, done: float, total: float, text: str) -> None:
        """Note how far a running step is (`done` of `total`, in the step's own unit) and what it does; `tick` shows it."""
        live = self.running[step]
        live.share = min(done / total, 1.0) if total else 0.0
        live.words = f"{f'{done / total:4.0%}' if total else ''} {printable(text)}".strip()

    def tick(self) -> None:
        """Show life: print a line for every step that has been silent for BEAT seconds."""
        now, left = time.monotonic(), in_words(self.seconds_left())
        for step, live in self.running.items():
            if now - live.spoke >= BEAT:
                live.spoke = now
                self.line(step.stage, f"{step.of or '':<16} {now - live.started:6.0f} s  {live.words}  {left}")

    def warn(self, step: Step, text: str) -> None:
        """Print a warning; one that was printed before is left out."""
        if self._first(f"warning: {text}"):
            self.say(f"warning: {step}: {text}")

    def finish(self, step: Step, seconds: float) -> None:
        """A step is done, after `seconds`."""
        self.stages[step.stage][1] = max(0, self.stages[step.stage][1] - 1)  # a plan may know already that it is made
        self.running.pop(step, None)
        self.line(step.stage, f"{step.of or '':<16} {seconds:6.1f} s")

    def fail(self, step: Step, error: str, traceback: str | None) -> None:
        """A step ended with an error; `traceback` names the file with details of a defect of the program."""
        self.running.pop(step, None)
        self.say(f"error: {step}: {error}")
        if traceback:
            self.say(f"  this is a defect of the program, not of your input; details: {traceback}")

    def close(self) -> None:
        """Nothing more will be shown."""


class Bars(Display):
    """It shows on a terminal a bar for each stage that runs, warnings and errors above them; running steps count by their share."""

    def __init__(self) -> None:
        from rich import progress
        from rich.console import Console

        super().__init__()
        stream = sys.stderr.stream if isinstance(sys.stderr, Plain) else sys.stderr  # rich moves the cursor itself
        texts = [progress.TextColumn(f"{{task.{text}}}", markup=False) for text in ("description:<10", "fields[words]")]
        count = progress.TextColumn("{task.fields[count]:>7}")
        columns = [progress.SpinnerColumn(), texts[0], progress.BarColumn(24), count, progress.TimeElapsedColumn()]
        self.bars = progress.Progress(*columns, texts[1], console=Console(file=stream))
        self._rows: dict[str, int] = {}
        self._whole = 0.0  # the most seconds that were left
        self.bars.start()

    def say(self, text: str) -> None:
        """Print a line above the bars."""
        self.bars.console.print(printable(text), markup=False, highlight=False, soft_wrap=True)

    def line(self, stage: str, text: str) -> None:
        """Show it by the stage's bar."""
        self.tick()

    def tick(self) -> None:
        """Draw every bar anew, and above them one of the whole run where it is known how long that takes."""
        if left := self.seconds_left():
            self._whole = max(self._whole, left)
            if "all" not in self._rows:
                self._rows["all"] = self.bars.add_task("all", total=1.0, count="", words="")
            self.bars.update(self._rows["all"], completed=1 - left / self._whole, words=in_words(left))
        for stage in (stage for stage in self._told if stage in self.stages):
            if stage not in self._rows:
                self._rows[stage] = self.bars.add_task(stage, total=1.0, count="", words="")
            total, left = self.stages[stage]
            running = {step: live for step, live in self.running.items() if step.stage == stage}
            words = "; ".join(f"{step.of or ''} {live.words}".strip() for step, live in running.items())
            done, count = total - left + sum(live.share for live in running.values()), f"{total - left}/{total}"
            self.bars.update(self._rows[stage], completed=done, total=total, count=count, words=words[:80])
            if left == 0:
                self.bars.stop_task(self._rows[stage])

    def close(self) -> None:
        """Draw the bars a last time and give the terminal back."""
        self.tick()
        self.bars.stop()


def in_words(left: float | None) -> str:
    """What is said of the seconds that are left.

    >>> in_words(None), in_words(3), in_words(84), in_words(290)
    ('', '', 'about 80 s left', 'about 5 min left')
    """
    if left is None or left < 5:
        return ""
    return f"about {10 * math.ceil(left / 10 - 0.5)} s left" if left < 120 else f"about {left / 60:.0f} min left"


def display_for() -> Display:
    """What fits standard error; bars, and what draws them, are loaded for a terminal only."""
    return Bars() if sys.stderr.isatty() else Display()
