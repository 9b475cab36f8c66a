"""What a solve took: wall time, and processor time, which other work on the machine does not lengthen."""

from __future__ import annotations

import time

import msgspec


class Taken(msgspec.Struct, frozen=True):
    """Seconds since the start: of the wall clock, and of all of the process' threads."""

    wall: float
    processor: float


class Clock:
    """Runs from its making."""

    def __init__(self):
        self.start = self._now()

    def taken(self) -> Taken:
        return Taken(*(round(now - then, 3) for now, then in zip(self._now(), self.start, strict=True)))

    @staticmethod
    def _now() -> tuple[float, float]:
        return time.perf_counter(), time.process_time()
