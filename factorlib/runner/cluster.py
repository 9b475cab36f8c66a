"""Steps on a Dask cluster: each is a task with keys and paths, its result lands in the store, which all workers see.

A worker hands its task to a child process (`factorlib.runner.child`), so that bits do not depend on how workers were started.  A task
whose worker or child dies is tried again, on its own: nothing else is lost.
"""

from __future__ import annotations

import contextlib
import logging
import os
import threading
import time
import uuid
from collections.abc import Callable
from concurrent.futures import Future
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import msgspec

from factorlib.errors import InputError
from factorlib.runner.child import Child, Pools, taken
from factorlib.runner.project import LIBRARY
from factorlib.runner.worker import Outcome, Task, run_step

FRESH = 1.0  # seconds for which the scheduler is not asked again who its workers are
PATIENCE = 10  # seconds to reach a scheduler, for steps to end that are cancelled, and until the last worker is missed
AHEAD = 2  # steps are handed out for so many times the cores, so that no worker waits for its next one
TRIES = 3  # of a task whose process dies


class Site(msgspec.Struct, frozen=True):
    """What a worker must share with a run: its folder in the store, and the files of the library."""

    run: Path
    library: Path = LIBRARY

    def fault(self) -> InputError | None:
        """What hinders this process from working for the run."""
        here = f"the worker on {os.uname().nodename}"
        if not self.run.is_dir():
            cure = "keep build/ and the data on a file system that all machines mount at the same path"
            return InputError(f"{here} does not see the run's folder", file=self.run, cure=cure)
        if self.library != LIBRARY:
            start = started_by("<scheduler>", self.library)
            return InputError(f"{here} runs the code in {LIBRARY}", file=self.library, cure=start)
        return None


def started_by(scheduler: str, library: Path = LIBRARY) -> str:
    """The command line that starts a worker as it must be."""
    return f"start the worker by: cd {library} && .venv/bin/dask worker {scheduler}"


# ── the run ──────────────────────────────────────────────────────────────────────────────────────────────────────────


class Cluster(Pools):
    """The executor of the workers of a Dask scheduler at an address.  run: folder of the run, in the store

    Raises InputError where no scheduler answers there, or a worker cannot do what it must.
    """

    def __init__(self, scheduler: str, run: Path, say: Callable[[str], None]):
        if find_spec("distributed") is None:
            cure = "make setup EXTRAS=dask, or pip install 'factorlib[dask]'"
            raise InputError("Dask is not installed", key="executor", cure=cure)
        from distributed import Client

        self.site, self._busy, self._over = Site(run), {}, threading.Event()
        self._known: tuple[float, dict[str, int]] = (-FRESH, {})
        for name in ("distributed", "distributed.client", "distributed.core", "distributed.comm"):
            logging.getLogger(name).setLevel(logging.CRITICAL)  # what they say of a lost connection is in the outcome
        say(f"connecting to {scheduler}")
        try:
            self.client = Client(scheduler, timeout=PATIENCE, set_as_default=False)
        except Exception as error:  # what answers there may be anything: an HTTP server, garbage
            cure = "start one: dask scheduler --port 8786; or leave the executor out, for processes of this machine"
            words = f"no Dask scheduler answers at {scheduler} ({str(error) or f'nothing in {PATIENCE} s'})"
            raise InputError(words, key="executor", cure=cure) from error
        try:
            for fault in filter(None, self.client.run(Site.fault, self.site).values()):
                raise fault
            self._executor = self.client.get_executor(pure=False, retries=TRIES - 1)
        except BaseException:
            self.client.close()
            raise
        threading.Thread(target=self._miss_workers, args=(scheduler, say), daemon=True).start()

    @property
    def workers(self) -> dict[str, int]:
        """The cores of each worker, by its address, as the scheduler said not long ago."""
        asked, known = self._known
        if time.monotonic() - asked >= FRESH:
            with contextlib.suppress(Exception):  # of a scheduler that is gone, which ends the tasks too
                known = self.client.nthreads()
            self._known = time.monotonic(), known
        return known

    @property
    def cores(self) -> int:
        """Those of the largest worker that is there now; 1 where none is."""
        return max(self.workers.values(), default=1)

    def most(self) -> int:
        """The cores of the steps that may be handed out."""
        return AHEAD * sum(self.workers.values())

    def submit(self, cores: int, threads: int, function: Callable, argument: Any) -> Future:
        """Hand out a step, by its task; its future."""
        future = self._executor.submit(hosted, self.site, threads, argument)
        self._busy[future] = cores
        return future

    def close(self, kill: bool = False) -> None:
        """Leave the cluster; `kill`: tasks that are not finished are cancelled, and their processes killed."""
        self._over.set()
        self._executor.shutdown(wait=not kill)
        end = time.monotonic() + PATIENCE * kill
        with contextlib.suppress(Exception):  # of a cluster that is gone
            while time.monotonic() < end and any(self.client.run(at_work, self.site.run).values()):
                time.sleep(0.1)
        self.client.close()

    def _miss_workers(self, scheduler: str, say: Callable[[str], None]) -> None:
        """Say once that there is no worker.  Dask keeps its tasks for those that come."""
        last = -PATIENCE
        while not self._over.wait(FRESH):
            if self.workers:
                last = time.monotonic()
            elif time.monotonic() - last >= PATIENCE:
                start = started_by(scheduler)
                say(f"waiting: there is no worker at {scheduler}; {start}")
                last = float("inf")


# ── in a worker ──────────────────────────────────────────────────────────────────────────────────────────────────────

_children: list[Child] = []


def hosted(site: Site, threads: int, task: Task) -> Outcome:
    """Run a step in a child of this worker, which ends if nobody waits any more."""
    from distributed import get_worker

    worker = get_worker()
    key = worker.get_current_task()

    def wanted() -> bool:
        """False once the task is cancelled, which for Dask is a change of its state, no interruption; or the worker closes."""
        of_dask, status = worker.state.tasks.get(key), worker.status.name
        open_ = status in ("running", "paused", "closing_gracefully")
        return of_dask is not None and of_dask.state != "cancelled" and open_

    return taken(_children, threads, site.run).call(outcome_at, site, task, wanted=wanted)


def at_work(run: Path) -> bool:
    """Whether a task of that run has a child here."""
    return any(child.busy and child.run == run and child.process.poll() is None for child in _children)


# ── in the child of a step ───────────────────────────────────────────────────────────────────────────────────────────


def outcome_at(site: Site, task: Task) -> Outcome:
    """Run a step here.  Each try of a step has a temporary folder of its own: another may still be ending elsewhere."""
    if fault := site.fault():
        return Outcome(error=str(fault))
    temporary = task.temporary.with_name(f"{task.temporary.name}.{uuid.uuid4().hex[:8]}")
    return run_step(msgspec.structs.replace(task, temporary=temporary))
