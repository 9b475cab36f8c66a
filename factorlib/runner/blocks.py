"""A step in a child of a cluster's worker, and its `Inputs.map`: independent blocks of work as tasks of the same cluster.

Blocks are sent in pieces, a few for each core, and their results come back in order.  What a block warns of is warned of
in the step, and the first error in the blocks' order is the step's, as if it had computed them itself.
"""

from __future__ import annotations

import contextlib
import logging
import os
import sys
import traceback
import uuid
import warnings
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from logging.handlers import QueueHandler
from pathlib import Path
from queue import SimpleQueue
from types import ModuleType
from typing import Any

import msgspec

from factorlib.errors import InputError
from factorlib.runner.cost import Meter
from factorlib.runner.plan import Record
from factorlib.runner.project import LIBRARY
from factorlib.runner.worker import Code, Outcome, Task, check_params, run_step

PIECES = 4  # for each core: small enough that no core waits long for the last one
TRIES = 3  # of a task whose process dies
CORES = "cores"  # the resource that workers declare
FIRST = 10  # priority of blocks: a step waits for them
PYTHON = f"{sys.version_info[0]}.{sys.version_info[1]}"


class Site(msgspec.Struct, frozen=True):
    """What a worker must share with a run: its folder in the store, the files of the library, the version of Python."""

    run: Path
    library: Path = LIBRARY
    python: str = PYTHON

    def fault(self, record: Record | None = None) -> InputError | None:
        """What hinders this process from working for the run; a step's record asks for the versions that it names, too."""
        here, start = f"the worker on {os.uname().nodename}", started_by("<scheduler>", self.library)
        if not self.run.is_dir():
            cure = "keep build/ and the data on a file system that all machines mount at the same path"
            return InputError(f"{here} does not see the run's folder", file=self.run, cure=cure)
        if self.library != LIBRARY:
            return InputError(f"{here} runs the code in {LIBRARY}", file=self.library, cure=start)
        if self.python != PYTHON:
            return InputError(f"{here} has Python {PYTHON}, the run has {self.python}", cure=start)
        for name, wanted in (record or {}).items():
            package = name.removeprefix("package:")
            if package != name and (installed := _version(package)) != wanted:
                cure = "make setup, in the same checkout"
                return InputError(f"{here} has {package} {installed}, the run has {wanted}", cure=cure)
        return None


def started_by(scheduler: str, library: Path = LIBRARY) -> str:
    """The command line that starts a worker as it must be."""
    return f"start the worker by: cd {library} && .venv/bin/python -m factorlib worker {scheduler}"


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "none"


# ── in the child of a step ───────────────────────────────────────────────────────────────────────────────────────────


def outcome_at(scheduler: str, site: Site, work: Task | Code) -> Outcome:
    """Run a step here, or check the parameters of one; a step's independent work goes to the cluster.

    Each try of a step has a temporary folder of its own: another may still be ending elsewhere.
    """
    if fault := site.fault(work.record if isinstance(work, Task) else None):
        return Outcome(error=str(fault))
    if isinstance(work, Code):
        return check_params(work)
    temporary = work.temporary.with_name(f"{work.temporary.name}.{uuid.uuid4().hex[:8]}")
    work = msgspec.structs.replace(work, temporary=temporary)
    if work.code.cores == 1:
        return run_step(work)
    with contextlib.closing(Blocks(scheduler, site, work)) as blocks:
        return run_step(work, blocks)


class Blocks:
    """An ordered map over the cluster at `scheduler`.  spent: what the blocks took elsewhere, for the step's log."""

    def __init__(self, scheduler: str, site: Site, task: Task):
        self.scheduler, self.site, self.code = scheduler, site, task.code
        self.shelf = parcel().Shelf(task.temporary.with_name(f"{task.temporary.name}.shelf"))
        sizes = dict.fromkeys(("maps", "tasks", "bytes_sent", "bytes_shelved", "bytes_back"), 0)
        self.spent: dict[str, Any] = {**sizes, "cpu_seconds": 0.0, "memory_mb": 0.0}
        self._client: Any = None

    def __call__(self, function: Callable, items: Iterable) -> list:
        """The function of every item, in order.  Raises what the first of them raised."""
        pieces = _pieces(list(items), PIECES * self.code.cores)
        if sum(map(len, pieces)) <= 1:
            return [function(item) for piece in pieces for item in piece]
        packed = self.shelf.pack([(function, piece) for piece in pieces])
        values = [value for back in self._computed(packed) for value in self._taken(back)]
        self.spent["maps"] += 1
        self.spent["tasks"] += len(pieces)
        self.spent["bytes_sent"] += sum(map(len, packed))
        self.spent["bytes_shelved"] = self.shelf.written
        return values

    def close(self) -> None:
        """Leave the cluster; tasks that are still there are cancelled."""
        if self._client is not None:
            self._client.close()

    def _computed(self, packed: list[bytes]) -> list[bytes]:
        from distributed import Client

        from factorlib.runner.cluster import hosted

        self._client = self._client or Client(self.scheduler, set_as_default=False)
        here = partial(hosted, self.site, self.code.threads, False, block_at)
        options = {"priority": FIRST, "retries": TRIES - 1, "resources": {CORES: self.code.threads}, "pure": False}
        work = [(self.code.root, data) for data in packed]
        return self._client.gather(self._client.map(here, work, **options))

    def _taken(self, back: bytes) -> list:
        values, records, error, cost = parcel().unpack(back)
        self.spent["bytes_back"] += len(back)
        self.spent["cpu_seconds"] += cost["cpu_seconds"]
        self.spent["memory_mb"] = max(self.spent["memory_mb"], cost["memory_mb"])
        for record in records:
            logging.getLogger(record.name).handle(record)
        if error is not None:
            raise error
        return values


def _pieces(items: list, count: int) -> list[list]:
    """
    >>> _pieces([1, 2, 3, 4, 5], 2), _pieces([1], 4), _pieces([], 4)
    ([[1, 2], [3, 4, 5]], [[1]], [])
    """
    count = min(count, len(items))
    return [items[len(items) * k // count : len(items) * (k + 1) // count] for k in range(count)]


# ── in the child of a block ──────────────────────────────────────────────────────────────────────────────────────────


def block_at(scheduler: str, site: Site, work: tuple[Path, bytes]) -> bytes:
    """What the function gave of each item of a piece, what was warned of, the first error and the cost, packed.

    work: the project's root, and the packed function and items
    """
    if fault := site.fault():
        raise fault
    root, data = work
    if str(root) not in sys.path:
        sys.path.insert(0, str(root))
    meter, values, error = Meter(), [], None
    with _recorded() as records:
        function, items = parcel().unpack(data)
        try:
            for item in items:
                values.append(function(item))
        except Exception as caught:
            caught.add_note(traceback.format_exc())
            error = caught
    return parcel().pack((values, records, error, meter.read(1, 1)))


@contextlib.contextmanager
def _recorded() -> Iterator[list[logging.LogRecord]]:
    """What is warned of within, as a step's `Events` would see it, with its text put together."""
    records: list[logging.LogRecord] = []
    handler = QueueHandler(SimpleQueue())
    handler.setLevel(logging.WARNING)
    handler.enqueue = records.append
    loggers = [logging.getLogger(name) for name in ("factorlib", "py.warnings")]
    logging.captureWarnings(True)
    warnings.simplefilter("ignore", DeprecationWarning)
    for logger in loggers:
        logger.addHandler(handler)
        logger.propagate = False
    try:
        yield records
    finally:
        for logger in loggers:
            logger.removeHandler(handler)


def parcel() -> ModuleType:
    """`factorlib.parcel`, by its name as stages are: it imports science."""
    return import_module("factorlib.parcel")
