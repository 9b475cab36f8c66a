"""SIGTERM ends a command as cleanly as Ctrl-C does: what was finished is kept, the workers are stopped, the exit code says it."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator
from types import FrameType

INTERRUPTED, TERMINATED = 128 + signal.SIGINT, 128 + signal.SIGTERM  # exit codes, as shells count


@contextlib.contextmanager
def heed_stops() -> Iterator[None]:
    """Within, SIGTERM raises SystemExit and SIGINT KeyboardInterrupt, once: those that follow disturb no cleaning up."""
    in_main_thread = threading.current_thread() is threading.main_thread()  # where alone Python may say what signals do
    numbers = [n for n in (signal.SIGINT, signal.SIGTERM) if in_main_thread and signal.getsignal(n) != signal.SIG_IGN]
    before = {number: signal.signal(number, _stop) for number in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def take_sigterm_back() -> None:
    """What Python does at SIGTERM holds again: pycolmap, once imported, prints a C stack instead."""
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGTERM))


def _stop(number: int, frame: FrameType | None = None) -> None:
    for each in (signal.SIGINT, signal.SIGTERM):
        signal.signal(each, signal.SIG_IGN)
    raise SystemExit(TERMINATED) if number == signal.SIGTERM else KeyboardInterrupt
