"""Where steps run: `concurrent.futures` executors of one process each, all within the machine's cores.

The number of threads of a step's numerics is part of its spec, for sums depend on it; how many steps run at once, and over
how many cores a step spreads independent work, is the machine's affair.  A process pool whose process is killed gives up all
its work, so each has one process and one step: what is killed is that step's affair alone.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import Any

from factorlib import arithmetic
from factorlib.runner.stop import whole
from factorlib.runner.worker import limit_threads


class Pools:
    """Executors by number of threads; `free` says whether a step that needs so many cores may start now."""

    def __init__(self) -> None:
        self.cores = machine_cores()
        self._spare: dict[int, list[Executor]] = {}
        self._busy: dict[Future, tuple[int, int, Executor]] = {}

    def free(self, cores: int) -> bool:
        """Whether a step of `cores` cores may start now: the cores suffice, or nothing else runs."""
        busy = sum(taken for taken, _, _ in self._busy.values())
        return busy == 0 or busy + cores <= self.cores

    def submit(self, cores: int, threads: int, function: Callable, *arguments: Any) -> Future:
        """Start `function(*arguments)` in a worker process of `threads` threads, which takes `cores` cores; returns its future."""
        with whole(), _environment():
            spare = self._spare.setdefault(threads, [])
            executor = spare.pop() if spare else _executor(threads)
            try:
                future = executor.submit(function, *arguments)
            except BrokenProcessPool:  # its process was killed while it had nothing to do
                executor.shutdown()
                return self.submit(cores, threads, function, *arguments)
            self._busy[future] = cores, threads, executor
            return future

    def done(self, future: Future) -> None:
        """Take a finished future's worker back, for the next step of as many threads."""
        _, threads, executor = self._busy.pop(future)
        self._spare[threads].append(executor)

    def close(self, kill: bool = False) -> None:
        """End all worker processes; `kill`: at once, whatever they do."""
        executors = [e for spare in self._spare.values() for e in spare] + [e for _, _, e in self._busy.values()]
        for process in multiprocessing.active_children() if kill else []:
            process.kill()
        # Each executor is shut down by one call that waits.  After `shutdown(wait=False)` a second call would not wait, and its
        # thread could still be closing pipes when Python ends, which prints a traceback.
        with ThreadPoolExecutor(max(1, len(executors))) as enders:
            list(enders.map(lambda executor: executor.shutdown(cancel_futures=True), executors))


def machine_cores() -> int:
    """The processor cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextlib.contextmanager
def _environment() -> Iterator[None]:
    """Workers that start within walk their sets in the same order, and compute the same bits, every time."""
    fixed = {"PYTHONHASHSEED": "0", **arithmetic.VARIABLES}
    before = {name: os.environ[name] for name in fixed if name in os.environ}
    os.environ.update(fixed)
    try:
        yield
    finally:
        for name in fixed.keys() - before.keys():
            os.environ.pop(name, None)
        os.environ.update(before)


def _executor(threads: int) -> Executor:
    context = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(1, mp_context=context, initializer=_start, initargs=(threads, os.getpid()))


def _start(threads: int, parent: int) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent stops its workers
    limit_threads(threads)
    threading.Thread(target=_die_with, args=(parent,), daemon=True).start()


def _die_with(parent: int) -> None:
    """Nobody waits for a worker whose parent was killed."""
    while os.getppid() == parent:
        time.sleep(0.3)
    os._exit(1)
