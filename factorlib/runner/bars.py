"""The display on a terminal: one bar for each stage that runs, warnings and errors above them."""

from __future__ import annotations

import sys

from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

from factorlib.runner.display import Display
from factorlib.runner.plan import Step
from factorlib.runner.terminal import own, printable


class Bars(Display):
    """A bar counts its stage's steps; those that run count by how far they say they are."""

    def __init__(self, console: Console | None = None):
        super().__init__()
        self.console = console or Console(file=own(sys.stderr))
        columns = [SpinnerColumn(), TextColumn("{task.description:<10}"), BarColumn(24), TextColumn("{task.fields[count]:>7}")]
        self.bars = Progress(*columns, TimeElapsedColumn(), TextColumn("{task.fields[words]}", markup=False), console=self.console)
        self._rows: dict[str, int] = {}
        self._running: dict[Step, float] = {}
        self.bars.start()

    def say(self, text: str) -> None:
        """Print a line above the bars."""
        self.bars.console.print(printable(text), markup=False, highlight=False, soft_wrap=True)

    def start(self, step: Step) -> None:
        """Count a step as running; its stage gets a bar if it has none."""
        self._running[step] = 0.0
        if step.stage not in self._rows:
            self._rows[step.stage] = self.bars.add_task(step.stage, total=1.0, count="", words="")
        self._refresh(step.stage)

    def progress(self, step: Step, done: float, total: float, text: str) -> None:
        """Note how far a running step is (`done` of `total`, in the step's own unit) and what it does."""
        self._running[step] = min(done / total, 1.0) if total else 0.0
        self._words[step] = printable(text)
        self._refresh(step.stage)

    def tick(self) -> None:
        """Draw every bar anew; called about once a second."""
        for stage in self._rows:
            self._refresh(stage)

    def finish(self, step: Step, seconds: float) -> None:
        """Count a step as done; `seconds` is not shown here."""
        self.count_off(step)
        self._running.pop(step, None)
        self._words.pop(step, None)
        self._refresh(step.stage)

    def fail(self, step: Step, error: str, traceback: str | None) -> None:
        """Count a step as ended, and print its error."""
        self._running.pop(step, None)
        self._refresh(step.stage)
        super().fail(step, error, traceback)

    def _refresh(self, stage: str) -> None:
        if stage not in self._rows:
            return
        total, left = self.totals.get(stage, 1), self.left.get(stage, 1)
        done = total - left + sum(share for step, share in self._running.items() if step.stage == stage)
        words = "; ".join(f"{step.of or ''} {self._words.get(step, '')}".strip() for step in self._running if step.stage == stage)
        self.bars.update(self._rows[stage], completed=done, total=total, count=f"{total - left}/{total}", words=words[:80])
        if left == 0:
            self.bars.stop_task(self._rows[stage])

    def close(self) -> None:
        """Draw the bars a last time and give the terminal back."""
        self.tick()
        self.bars.stop()
