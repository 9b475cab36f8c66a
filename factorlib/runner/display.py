"""What a user sees of a run where there is no terminal: plain lines; a long step always shows life."""

from __future__ import annotations

import sys
import time
from typing import TextIO

from factorlib.runner.plan import Planned, Step
from factorlib.runner.terminal import printable

BEAT = 10.0  # seconds between two plain lines about the same step


class Display:
    """Plain lines: what starts, what it warns of, how long it took."""

    def __init__(self, stream: TextIO | None = None):
        self.stream = stream or sys.stderr
        self.totals: dict[str, int] = {}
        self.left: dict[str, int] = {}
        self._warned: set[str] = set()
        self._waited: set[Step] = set()
        self._begun: set[str] = set()
        self._spoke: dict[Step, float] = {}
        self._started: dict[Step, float] = {}
        self._words: dict[Step, str] = {}

    def plan(self, planned: list[Planned]) -> None:
        """The state of the plan as it is now."""
        self.totals, self.left = {}, {}
        for p in planned:
            self.totals[p.step.stage] = self.totals.get(p.step.stage, 0) + 1
            self.left[p.step.stage] = self.left.get(p.step.stage, 0) + (p.status != "current")

    def count_off(self, step: Step) -> None:
        """One is done since the plan was made."""
        self.left[step.stage] = self.left.get(step.stage, 1) - 1

    def say(self, text: str) -> None:
        """Print a line."""
        print(printable(text), file=self.stream, flush=True)

    def start(self, step: Step) -> None:
        """A step begins; printed for the first step of a stage only."""
        self._started[step] = self._spoke[step] = time.monotonic()
        if step.stage not in self._begun:
            self._begun.add(step.stage)
            left = self.left.get(step.stage, 1)
            self.say(f"{step.stage:<10} " + ("…" if step.of is None else f"{left} {'photo' if step.photo else 'recipe'}{'s' * (left > 1)} …"))

    def waits(self, step: Step) -> None:
        """A step waits for another run to make its result; printed once."""
        if step not in self._waited:
            self._waited.add(step)
            self.say(f"{step}: waiting: another run is making it")

    def progress(self, step: Step, done: float, total: float, text: str) -> None:
        """Note how far a running step is (`done` of `total`, in the step's own unit) and what it does; `tick` prints it."""
        share = f"{done / total:4.0%}" if total else ""
        self._words[step] = f"{share} {text}".strip()

    def tick(self) -> None:
        """Print a line for every step that has been silent for BEAT seconds."""
        now = time.monotonic()
        for step, spoke in self._spoke.items():
            if now - spoke >= BEAT:
                self._spoke[step] = now
                self.say(
                    f"{step.stage:<10} {step.of or '':<16} {now - self._started[step]:6.0f} s  {self._words.get(step, '')}".rstrip()
                )

    def warn(self, step: Step, text: str) -> None:
        """Print a warning; one that was printed before is left out."""
        if text not in self._warned:
            self._warned.add(text)
            self.say(f"warning: {step}: {text}")

    def finish(self, step: Step, seconds: float) -> None:
        """A step is done, after `seconds`."""
        self.count_off(step)
        self._spoke.pop(step, None)
        self.say(f"{step.stage:<10} {step.of or '':<16} {seconds:6.1f} s")

    def fail(self, step: Step, error: str, traceback: str | None) -> None:
        """A step ended with an error; `traceback` names the file with details of a defect of the program."""
        self._spoke.pop(step, None)
        self.say(f"error: {step}: {error}")
        if traceback:
            self.say(f"  this is a defect of the program, not of your input; details: {traceback}")

    def close(self) -> None:
        """Nothing more will be shown."""
