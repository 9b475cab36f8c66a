"""A step in a child of a cluster's worker, and its `Inputs.map`: independent blocks of work as tasks of the same cluster.

Blocks are sent in pieces, a few for each core, and their results come back in order.  What a block warns of is warned of in the step,
and the first error in the blocks' order is the step's, as if it had computed them itself.
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
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
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


class Site(msgspec.Struct, frozen=True):
    """What a worker must share with the run: its folder, the files of the library, the version of Python.

    run: the run's folder in the store;  mark: a file there
    """

    run: Path
    mark: Path
    library: Path = LIBRARY
    python: str = f"{sys.version_info[0]}.{sys.version_info[1]}"

    def check(self, record: Record | None = None) -> None:
        """InputError where this process is not at that site, or has not the versions of a step's record."""
        here = f"the worker on {os.uname().nodename}"
        if not self.mark.is_file():
            cure = "keep build/ and the data on a file system that all machines mount at the same path"
            raise InputError(f"{here} does not see the run's folder", file=self.run, cure=cure)
        if self.library != LIBRARY:
            raise InputError(
                f"{here} runs the code in {LIBRARY}", file=self.library, cure=started_by("<scheduler>", self.library)
            )
        if self.python != (python := f"{sys.version_info[0]}.{sys.version_info[1]}"):
            raise InputError(
                f"{here} has Python {python}, the run has {self.python}", cure=started_by("<scheduler>", self.library)
            )
        for name, wanted in (record or {}).items():
            package = name.removeprefix("package:")
            if package != name and (found := _version(package)) != wanted:
                raise InputError(
                    f"{here} has {package} {found}, the run has {wanted}", cure="make setup, in the same checkout"
                )


def started_by(scheduler: str, library: Path = LIBRARY) -> str:
    """The command line that starts a worker as it must be."""
    return f"start the worker by: cd {library} && .venv/bin/python -m factorlib worker {scheduler}"


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "none"


# ── in the child of a step ───────────────────────────────────────────────────────────────────────────────────────────


def step_at(scheduler: str, site: Site, task: Task) -> Outcome:
    """Run a step here; where it may spread over several cores, its independent work goes to the cluster.

    Each try has a temporary folder of its own: another may still be ending elsewhere.
    """
    try:
        site.check(task.record)
    except InputError as error:
        return Outcome(error=str(error))
    temporary = task.temporary.with_name(f"{task.temporary.name}.{uuid.uuid4().hex[:8]}")
    task = msgspec.structs.replace(task, temporary=temporary)
    if task.code.cores == 1:
        return run_step(task)
    with contextlib.closing(Blocks(scheduler, site, task)) as blocks:
        return run_step(task, blocks)


def params_at(scheduler: str, site: Site, code: Code) -> Outcome:
    """`check_params` here."""
    try:
        site.check()
    except InputError as error:
        return Outcome(error=str(error))
    return check_params(code)


class Blocks:
    """An ordered map over the cluster at `scheduler`.  spent: what the blocks took elsewhere, for the step's log."""

    def __init__(self, scheduler: str, site: Site, task: Task):
        self.scheduler, self.site, self.code = scheduler, site, task.code
        self.shelf = parcel().Shelf(task.temporary.with_name(f"{task.temporary.name}.shelf"))
        self.spent = {
            "maps": 0,
            "tasks": 0,
            "cpu_seconds": 0.0,
            "memory_mb": 0.0,
            "bytes_sent": 0,
            "bytes_shelved": 0,
            "bytes_back": 0,
        }
        self._client: Any = None

    def __call__(self, function: Callable, items: Iterable) -> list:
        """The function of every item, in order.  Raises what the first of them raised."""
        pieces = _pieces(list(items), PIECES * self.code.cores)
        if sum(map(len, pieces)) <= 1:
            return [function(item) for piece in pieces for item in piece]
        packed = self.shelf.pack([(function, piece) for piece in pieces])
        found = [value for back in self._computed(packed) for value in self._taken(back)]
        self.spent["maps"] += 1
        self.spent["tasks"] += len(pieces)
        self.spent["bytes_sent"] += sum(map(len, packed))
        self.spent["bytes_shelved"] = self.shelf.written
        return found

    def close(self) -> None:
        """Leave the cluster; tasks that are still there are cancelled."""
        if self._client is not None:
            self._client.close()

    def _computed(self, packed: list[bytes]) -> list[bytes]:
        from distributed import Client

        from factorlib.runner.host import hosted

        if self._client is None:
            self._client = Client(self.scheduler, set_as_default=False)
        options = {"pure": False, "priority": FIRST, "retries": TRIES - 1, "resources": {CORES: self.code.threads}}
        task = self.site.run, self.code.threads, False, block_at, self.site, self.code.root
        return self._client.gather([self._client.submit(hosted, *task, data, **options) for data in packed])

    def _taken(self, back: bytes) -> list:
        done = parcel().unpack(back)
        self.spent["bytes_back"] += len(back)
        self.spent["cpu_seconds"] += done.cpu_seconds
        self.spent["memory_mb"] = max(self.spent["memory_mb"], done.memory_mb)
        for record in done.said:
            logging.getLogger(record.name).handle(record)
        if done.error is not None:
            raise done.error
        return done.values


def _pieces(items: list, count: int) -> list[list]:
    """
    >>> _pieces([1, 2, 3, 4, 5], 2), _pieces([1], 4)
    ([[1, 2], [3, 4, 5]], [[1]])
    """
    count = min(count, len(items))
    ends = [len(items) * k // count for k in range(count + 1)] if items else []
    return [items[first:last] for first, last in zip(ends, ends[1:])]


# ── in the child of a block ──────────────────────────────────────────────────────────────────────────────────────────


class Done(msgspec.Struct):
    """What a piece gave, warned of and cost; error: what the first block raised that failed."""

    values: list[Any]
    said: list[logging.LogRecord]
    error: BaseException | None
    cpu_seconds: float
    memory_mb: float


def block_at(scheduler: str, site: Site, root: Path, data: bytes) -> bytes:
    """The function of every item of a piece, all of it packed."""
    site.check()
    if str(root) not in sys.path:
        sys.path.insert(0, str(root))
    meter, values, error = Meter(), [], None
    with _recorded() as said:
        function, items = parcel().unpack(data)
        try:
            for item in items:
                values.append(function(item))
        except Exception as caught:
            caught.add_note(traceback.format_exc())
            error = caught
    cost = meter.read(1, 1)
    return parcel().pack(Done(values, said, error, cost["cpu_seconds"], cost["memory_mb"]))


@contextlib.contextmanager
def _recorded() -> Iterator[list[logging.LogRecord]]:
    """What is warned of within, as a step's `Events` would see it."""
    said: list[logging.LogRecord] = []
    handler = logging.Handler(logging.WARNING)
    handler.emit = lambda record: said.append(_plain(record))
    loggers = [logging.getLogger(name) for name in ("factorlib", "py.warnings")]
    logging.captureWarnings(True)
    warnings.simplefilter("ignore", DeprecationWarning)
    for logger in loggers:
        logger.addHandler(handler)
        logger.propagate = False
    try:
        yield said
    finally:
        for logger in loggers:
            logger.removeHandler(handler)


def _plain(record: logging.LogRecord) -> logging.LogRecord:
    """The record with its text put together: its arguments may be anything."""
    record.msg, record.args, record.exc_info = record.getMessage(), None, None
    return record


def parcel() -> ModuleType:
    """`factorlib.parcel`, by its name as stages are: it imports science."""
    return import_module("factorlib.parcel")
