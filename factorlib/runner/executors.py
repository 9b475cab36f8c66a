"""Where steps run: child processes of this machine, one for each step that runs, all within the machine's cores.

The number of threads of a step's numerics is part of its spec, for sums depend on it; how many steps run at once, and over
how many cores a step spreads independent work, is the machine's affair.  `factorlib.runner.cluster` has the same interface.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

from factorlib.runner.child import Children
from factorlib.runner.stop import whole


class Pools:
    """Children that compute, each waited for by a thread.  cores: how many they may keep busy, default this machine's"""

    AHEAD = 1  # steps are handed out for so many times the cores

    def __init__(self, cores: int | None = None):
        self.cores = cores or machine_cores()
        self._children, self._threads = Children(), ThreadPoolExecutor(1 << 16)  # as many as there are steps at once
        self._busy: dict[Future, int] = {}

    def free(self, cores: int) -> bool:
        """Whether a step of `cores` cores may start now: the cores suffice, or nothing else runs."""
        return not self._busy or sum(self._busy.values()) + cores <= self.AHEAD * self.cores

    def submit(self, cores: int, threads: int, function: Callable, *arguments: Any) -> Future:
        """Start `function(*arguments)` in a process of `threads` threads, which takes `cores` cores; its future."""
        with whole():
            child = self._children.take(threads, Path("/"))
            future = self._threads.submit(child.call, function, *arguments)
            self._busy[future] = cores
            return future

    def done(self, future: Future) -> None:
        """Take note that a future is finished."""
        del self._busy[future]

    def close(self, kill: bool = False) -> None:
        """End all processes; `kill`: at once, whatever they do."""
        if kill:
            for child in self._children.all:
                child.process.kill()
        self._threads.shutdown()
        for child in self._children.all:
            child.end(kill)


def machine_cores() -> int:
    """The processor cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
