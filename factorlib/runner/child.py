"""A process that computes for a worker of a cluster, which itself computes nothing.

How many threads a library uses, which instructions it may use, and in which order sets are walked, is fixed when a
process starts.  A worker of a cluster was started by others, in whatever environment, and stays for days.  So it starts a
child for the steps of one run and one number of threads, in the environment that the runner's own workers have, with the
modules that are on disk now.  A library that crashes, or a step that is killed for want of memory, ends the child alone.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from factorlib import arithmetic
from factorlib.runner.project import LIBRARY
from factorlib.runner.worker import THREAD_VARIABLES, limit_threads

TRIM = "MALLOC_TRIM_THRESHOLD_"
WATCH = 0.3  # seconds between two looks at whether the work is still wanted
MAIN = f"import sys; sys.path.insert(0, {str(LIBRARY)!r}); from factorlib.runner.child import main; main()"


class Died(BrokenProcessPool):
    """The child was killed from outside, or for want of memory, or crashed in a library."""


class Unwanted(Exception):
    """Nobody waits for the result any more."""


def environment(threads: int) -> dict[str, str]:
    """What a process that computes is started with: `threads` threads of every library, the same order of sets and the same instructions.

    Dask's nanny has its workers give memory back at once, and glibc then asks the system for each large array anew: sums of
    700 × 700 numbers take three times as long.  Children are started without that.
    """
    fixed = {"PYTHONHASHSEED": "0", **arithmetic.VARIABLES, **dict.fromkeys(THREAD_VARIABLES, str(threads))}
    return {name: value for name, value in os.environ.items() if name != TRIM} | fixed


class Child:
    """A child of this process; run: the folder of its run, with which it ends."""

    def __init__(self, threads: int, run: Path):
        self.connection, theirs = Pipe()
        command = [sys.executable, "-P", "-c", MAIN, str(theirs.fileno()), str(threads), str(os.getpid()), str(run)]
        handle = theirs.fileno()
        self.process = subprocess.Popen(command, env=environment(threads), stdin=subprocess.DEVNULL, pass_fds=[handle])
        theirs.close()

    def call(self, wanted: Callable[[], bool], function: Callable, *arguments: Any) -> Any:
        """`function(*arguments)`, computed in the child.  Raises what it raises; `Died`; `Unwanted` once `wanted()` is false."""
        try:
            self.connection.send((function, arguments))
            while not self.connection.poll(WATCH):
                if not wanted():
                    raise Unwanted
            good, value = self.connection.recv()
        except (EOFError, OSError) as error:
            raise Died("its process died") from error
        if not good:
            raise value
        return value

    def kill(self) -> None:
        """End it at once, whatever it does."""
        self.process.kill()
        self.process.wait()
        self.connection.close()


# ── in the child ─────────────────────────────────────────────────────────────────────────────────────────────────────


def main() -> None:
    """Answer calls until the parent is gone."""
    handle, threads, parent, run = sys.argv[1:]
    for number in (signal.SIGINT, signal.SIGTERM):  # the parent ends it
        signal.signal(number, signal.SIG_IGN)
    limit_threads(int(threads))
    threading.Thread(target=_end_with, args=(int(parent), Path(run)), daemon=True).start()
    connection = Connection(int(handle))
    with contextlib.suppress(EOFError, OSError):
        while True:
            function, arguments = connection.recv()
            connection.send(_answer(function, arguments))


def _answer(function: Callable, arguments: tuple) -> tuple[bool, Any]:
    try:
        return True, function(*arguments)
    except BaseException as error:  # whatever it is, it is the caller's
        return False, error


def _end_with(parent: int, run: Path) -> None:
    """Nobody waits for a child whose worker was killed, or whose run is over."""
    while os.getppid() == parent and run.is_dir():
        time.sleep(WATCH)
    os._exit(1)
