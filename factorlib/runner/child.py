"""Processes that compute: every step runs in a child, of a run on this machine or of a worker of a cluster.

How many threads a library uses, which instructions, and in which order sets are walked, is fixed when a process starts,
and results depend on it.  So each child is started for one number of threads, in an environment of its own, with the
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
from concurrent.futures import Future, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from multiprocessing.reduction import ForkingPickler
from pathlib import Path
from typing import Any

from factorlib.errors import InputError
from factorlib.runner.project import LIBRARY

THREAD_VARIABLES = [*(f"{of}_NUM_THREADS" for of in ("OMP", "MKL", "OPENBLAS", "NUMEXPR")), "VECLIB_MAXIMUM_THREADS"]
TRIM = "MALLOC_TRIM_THRESHOLD_"  # Dask's nanny sets it; sums of 700 × 700 numbers then take three times as long
WATCH = 0.3  # seconds between two looks at whether the work is still wanted
_taking = threading.Lock()
MAIN = f"import sys; sys.path.insert(0, {str(LIBRARY)!r}); from factorlib.runner.child import main; main()"


class Child:
    """A child of this process with `threads` threads in every library; run: a folder with which it ends."""

    def __init__(self, threads: int, run: Path):
        self.threads, self.run, self.busy = threads, run, False
        self.connection, theirs = Pipe()
        command = [sys.executable, "-P", "-c", MAIN, str(theirs.fileno()), str(os.getpid()), str(run)]
        fixed = {
            "PYTHONHASHSEED": "0",
            "OMP_WAIT_POLICY": "PASSIVE",  # threads that wait by spinning stand in the way of others, and of each other
            **dict.fromkeys(THREAD_VARIABLES, str(threads)),
        }
        environment = {name: value for name, value in os.environ.items() if name != TRIM} | fixed
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # the child inherits that: it never sees one
        self.process = subprocess.Popen(command, env=environment, stdin=subprocess.DEVNULL, pass_fds=[theirs.fileno()])
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        theirs.close()

    def call(self, function: Callable, *arguments: Any, wanted: Callable[[], bool] = lambda: True) -> Any:
        """`function(*arguments)`, computed in the child, which is free again afterwards.

        Raises what the function raises.  Raises BrokenProcessPool, and the child is no more, where it was killed from
        outside, or for want of memory, or crashed in a library, and once `wanted()` is false.
        """
        try:
            self.connection.send((function, arguments))
            while not self.connection.poll(WATCH):
                died = self.process.poll() is not None and not self.connection.poll()
                if died or not wanted():
                    raise EOFError
            good, value = self.connection.recv()
        except BaseException as error:
            self.end(kill=True)
            if isinstance(error, EOFError | OSError):
                raise BrokenProcessPool("its process died, or nobody waited for it") from error
            raise
        self.busy = False
        if not good:
            raise value
        return value

    def end(self, kill: bool) -> None:
        """End it: `kill`: at once, whatever it does."""
        if kill:
            self.process.kill()
        self.connection.close()  # it ends by itself at that
        self.process.wait()


def taken(children: list[Child], threads: int, run: Path) -> Child:
    """Return, of these children, one that is alive and free, of that run and number of threads, or a new one among them.

    It is busy until a call of it has returned.
    """
    with _taking:
        children[:] = [child for child in children if child.process.poll() is None]
        free = (child for child in children if not child.busy and (child.threads, child.run) == (threads, run))
        if (child := next(free, None)) is None:
            children.append(child := Child(threads, run))
        child.busy = True
        return child


class Pools:
    """The executor of this machine: children, each waited for by a thread.  cores: how many they may keep busy, default all.

    `factorlib.runner.cluster.Cluster` has the same interface.
    """

    def __init__(self, cores: int | None = None):
        can_say = hasattr(os, "sched_getaffinity")  # which cores this process may use
        self.cores = cores or (len(os.sched_getaffinity(0)) if can_say else os.cpu_count() or 1)
        self.children, self._threads = [], ThreadPoolExecutor(1 << 16)  # as many as there are steps at once
        self._busy: dict[Future, int] = {}

    def free(self, cores: int) -> bool:
        """Whether a step of `cores` cores may start now: the cores suffice, or nothing else runs."""
        self._busy = {future: count for future, count in self._busy.items() if not future.done()}
        return not self._busy or sum(self._busy.values()) + cores <= self.most()

    def most(self) -> int:
        """The cores of the steps that may be started."""
        return self.cores

    def submit(self, cores: int, threads: int, function: Callable, argument: Any) -> Future:
        """Start `function(argument)` in a process of `threads` threads, which takes `cores` cores; its future."""
        future = self._threads.submit(taken(self.children, threads, Path("/")).call, function, argument)
        self._busy[future] = cores
        return future

    def close(self, kill: bool = False) -> None:
        """End all processes; `kill`: at once, whatever they do."""
        if kill:
            for child in self.children:
                child.process.kill()
        self._threads.shutdown()
        for child in self.children:
            child.end(kill)


# ── in the child ─────────────────────────────────────────────────────────────────────────────────────────────────────


def main() -> None:
    """Answer calls until the parent is gone, or wants no more."""
    handle, parent, run = sys.argv[1:]
    for number in (signal.SIGINT, signal.SIGTERM):  # the parent ends it
        signal.signal(number, signal.SIG_IGN)

    def end_with_parent_and_run() -> None:
        while os.getppid() == int(parent) and Path(run).is_dir():
            time.sleep(WATCH)
        os._exit(1)

    threading.Thread(target=end_with_parent_and_run, daemon=True).start()
    connection = Connection(int(handle))
    with contextlib.suppress(EOFError, OSError):
        while True:
            function, arguments = connection.recv()
            try:
                answer = ForkingPickler.dumps((True, function(*arguments)))
            except BaseException as error:  # whatever it is, it is the caller's
                told = error if isinstance(error, InputError) else RuntimeError(f"{type(error).__name__}: {error}")
                answer = ForkingPickler.dumps((False, told))  # others may not survive being pickled
            connection.send_bytes(answer)
