"""SIGTERM ends a command as cleanly as Ctrl-C does: what was finished is kept, the workers are stopped, the exit code says it."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator

INTERRUPTED, TERMINATED = 128 + signal.SIGINT, 128 + signal.SIGTERM  # exit codes, as shells count


class Stopped(SystemExit):
    """SIGTERM came."""

    def __init__(self):
        super().__init__(TERMINATED)


@contextlib.contextmanager
def heed_sigterm() -> Iterator[None]:
    """Within, SIGTERM raises `Stopped`, once: a second one, which make sends on, disturbs no cleaning up."""
    if not _in_main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, _stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def take_sigterm_back() -> None:
    """What Python does at SIGTERM holds again: pycolmap, once imported, prints a C stack instead."""
    if _in_main_thread():
        signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGTERM))


def _in_main_thread() -> bool:
    """Only there may Python say what a signal does."""
    return threading.current_thread() is threading.main_thread()


def _stop(*_) -> None:
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    raise Stopped
