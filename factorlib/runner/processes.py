"""Executors of steps: processes of this machine, or of the workers of a Dask cluster.

How many threads a library uses, and in which order sets are walked, is fixed when a process starts, and results depend on it.
So each process is started for one number of threads, in an environment of its own, with the modules that are on disk now, and
runs one step at a time: a library that crashes, or a step that is killed for want of memory, ends that process alone.
A process ends with the one that started it, and with its run, whose lock it watches.
"""

from __future__ import annotations

import contextlib
import logging
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from importlib.util import find_spec
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Any

from factorlib.errors import InputError
from factorlib.runner.store import LOCK, is_locked

THREAD_VARIABLES = [*(f"{of}_NUM_THREADS" for of in ("OMP", "MKL", "OPENBLAS", "NUMEXPR")), "VECLIB_MAXIMUM_THREADS"]
FIXED = {
    "PYTHONHASHSEED": "0",
    "OMP_WAIT_POLICY": "PASSIVE",  # threads that wait by spinning stand in the way of others, and of each other
    "MALLOC_TRIM_THRESHOLD_": None,  # Dask's nanny sets it; sums of 700 × 700 numbers then take three times as long
}
WATCH = 0.3  # seconds between two looks at whether the run goes on
PATIENCE = 10  # seconds to reach a scheduler
AHEAD = 2  # steps are handed to a cluster for so many times its cores, so that no worker waits for its next one
TRIES = 3  # of a step whose process or worker dies, on a cluster
_starting = threading.Lock()


class Processes:
    """Processes of this machine.  run: folder of the run, with whose lock they end; None where there is no run."""

    def __init__(self, run: Path | None = None):
        self.run, self.pools, self._busy = run, [], {}
        can_say = hasattr(os, "sched_getaffinity")  # which cores this process may use
        self._cores = len(os.sched_getaffinity(0)) if can_say else os.cpu_count() or 1

    @property
    def cores(self) -> int:
        """Return the most cores that one step may have."""
        return self._cores

    @property
    def capacity(self) -> int:
        """Return the cores of the steps that may be started."""
        return self._cores

    def free(self, cores: int) -> bool:
        """Return whether a step of `cores` cores may start now: the cores suffice, or nothing else runs."""
        self._busy = {future: count for future, count in self._busy.items() if not future.done()}
        return not self._busy or sum(self._busy.values()) + cores <= self.capacity

    def submit(self, cores: int, threads: int, function: Callable, argument: Any) -> Future:
        """Start `function(argument)` in a process of `threads` threads, which takes `cores` cores."""
        with _starting:
            future = self._submit(threads, function, argument)
        self._busy[future] = cores
        return future

    def _submit(self, threads: int, function: Callable, argument: Any) -> Future:
        idle = (pool for of, pool, last in self.pools if of == threads and last.done() and last.exception() is None)
        if (pool := next(idle, None)) is None:
            pool = ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), _watch, (self.run,))
        self.pools = [each for each in self.pools if each[1] is not pool]
        resource_tracker.ensure_running()  # which unblocks SIGINT
        masked = signal.pthread_sigmask(
            signal.SIG_BLOCK, {signal.SIGINT}
        )  # the process inherits that: it never sees one
        fixed = FIXED | dict.fromkeys(THREAD_VARIABLES, str(threads))
        before = {name: os.environ.get(name) for name in fixed}
        try:
            _set_environment(fixed)
            future = pool.submit(function, argument)
        except BrokenProcessPool:  # it was killed while it had nothing to do
            return self._submit(threads, function, argument)
        finally:
            _set_environment(before)
            signal.pthread_sigmask(signal.SIG_SETMASK, masked)
        self.pools.append((threads, pool, future))
        return future

    def close(self) -> None:
        """End the processes, once the run's lock is free at once, else when they have done what they do."""
        for _, pool, _ in self.pools:
            pool.shutdown()


def _set_environment(values: dict[str, str | None]) -> None:
    for name, value in values.items():
        if value is None:
            os.environ.pop(name, None)
        else:
            os.environ[name] = value


def _watch(run: Path | None) -> None:
    """Begin a process: no signal but its parent's end, or that of its run, stops it."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)

    def end_with_parent_and_run() -> None:
        while multiprocessing.parent_process().is_alive() and (run is None or is_locked(run / LOCK)):
            time.sleep(WATCH)
        os._exit(1)

    threading.Thread(target=end_with_parent_and_run, daemon=True).start()


# ── on a cluster ─────────────────────────────────────────────────────────────────────────────────────────────────────


class Cluster(Processes):
    """Processes of the workers of a Dask scheduler.  Raises InputError where none answers at the address."""

    def __init__(self, scheduler: str, run: Path, say: Callable[[str], None]):
        if find_spec("distributed") is None:
            cure = "make setup EXTRAS=dask, or pip install 'factorlib[dask]'"
            raise InputError("Dask is not installed", key="executor", cure=cure)
        from distributed import Client

        super().__init__(run)
        self.scheduler, self.say, self._workers, self._asked = scheduler, say, {}, False
        for name in ("distributed", "distributed.client", "distributed.core", "distributed.comm"):
            logging.getLogger(name).setLevel(logging.CRITICAL)  # what they say of a lost connection is in the outcome
        say(f"connecting to {scheduler}")
        try:
            self.client = Client(scheduler, timeout=PATIENCE, set_as_default=False)
        except Exception as error:  # what answers there may be anything: an HTTP server, garbage
            cure = "start one: dask scheduler --port 8786; or leave the executor out, for processes of this machine"
            words = f"no Dask scheduler answers at {scheduler} ({str(error) or f'nothing in {PATIENCE} s'})"
            raise InputError(words, key="executor", cure=cure) from error
        self._executor = self.client.get_executor(pure=False, retries=TRIES - 1)

    @property
    def cores(self) -> int:
        """Return the cores of the largest worker that is there now, 1 where none is."""
        return max(self._workers.values(), default=1)

    @property
    def capacity(self) -> int:
        """Return the cores of the steps that may be handed out; say once that there is no worker."""
        with contextlib.suppress(Exception):  # of a scheduler that is gone, which ends the tasks too
            self._workers = self.client.nthreads()
        if not self._workers and not self._asked:
            self._asked = True  # Dask keeps its tasks for workers that come
            self.say(
                f"waiting: there is no worker at {self.scheduler}; start one: .venv/bin/dask worker {self.scheduler}"
            )
        return AHEAD * sum(self._workers.values())

    def _submit(self, threads: int, function: Callable, argument: Any) -> Future:
        return self._executor.submit(_on_worker, self.run, threads, function, argument)

    def close(self) -> None:
        """Leave the cluster; tasks that are not finished are cancelled, and their processes have ended."""
        if not all(future.done() for future in self._busy):
            time.sleep(2 * WATCH)
        self._executor.shutdown(wait=False)
        self.client.close()


_of_runs: dict[Path, Processes] = {}  # of a worker


def _on_worker(run: Path, threads: int, function: Callable, argument: Any) -> Any:
    """Compute `function(argument)` in a process of this worker, which itself was started by somebody else."""
    if not run.is_dir():
        cure = "keep build/ and the data on a file system that all machines mount at the same path"
        raise InputError(f"the worker on {os.uname().nodename} does not see the run's folder", file=run, cure=cure)
    multiprocessing.current_process().daemon = False  # those of Dask's nanny may start no process
    return _of_runs.setdefault(run, Processes(run)).submit(1, threads, function, argument).result()
