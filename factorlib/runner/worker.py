"""Steps in processes: of this machine, or of the workers of a Dask cluster.

The number of threads of a library and the order in which sets are walked are fixed when a process starts, and results
depend on both.  Each process is therefore started for one number of threads, in an environment of its own, with the
modules that are on disk at that time, and runs one step at a time.  A crash in a library or a lack of memory ends that
process alone.  A process ends with the one that started it, and with its run, whose lock it watches.

A task has keys and paths, never arrays, and its outcome is always an `Outcome`, so that an executor needs only
`submit`.  A running step writes progress and warnings to a file of events.
"""

from __future__ import annotations

import contextlib
import datetime
import importlib
import json
import logging
import multiprocessing
import os
import platform
import resource
import shutil
import signal
import sys
import threading
import time
import traceback
import uuid
import warnings
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from importlib.util import find_spec
from multiprocessing import resource_tracker
from pathlib import Path
from types import ModuleType
from typing import Any

import msgspec

from factorlib.errors import InputError
from factorlib.runner.closure import CODE, Sources
from factorlib.runner.plan import difference, hash_of
from factorlib.runner.project import LIBRARY, Stage, StageCode, restore_sigterm
from factorlib.runner.run_folder import LOCK
from factorlib.runner.store import (
    Entry,
    Stamp,
    Store,
    copy_shipped,
    finish_tree,
    hash_of_file,
    is_locked,
    stamps_of,
)
from factorlib.stage import Inputs, serial_map
from factorlib.wholefile import append_text, disk_error
from factorlib.yamlfile import convert

INTERVAL = 0.2  # seconds between two reports of progress


class Task(msgspec.Struct, frozen=True):
    """Description of a step for a worker.

    code:      module and parameters of the stage
    stage:     its declaration in pipeline.yaml
    folders:   folder of each input result
    facts:     facts of the dataset by slice
    files:     path by the field of the record that has the file's hash
    log:       log of the steps above; None for a stage that does not read it
    store:     root of the store
    key:       key of the step
    record:    record of the key
    temporary: folder for the unfinished result
    events:    file to which progress and warnings are written
    forced:    run the stage even if its result ships with the source
    """

    code: StageCode
    stage: Stage
    folders: dict[str, Path]
    facts: dict[str, Any]
    files: dict[str, Path]
    log: Path | None
    store: Path
    key: str
    record: dict[str, Any]
    temporary: Path
    events: Path
    forced: bool = False


class Outcome(msgspec.Struct, frozen=True):
    """Result or error of a finished step.

    output:    hash of the result; None after an error
    error:     message of the error; None after a success
    traceback: traceback of a defect of the program; None for an error that the user can fix
    seconds:   time that the step took
    """

    output: str | None = None
    error: str | None = None
    traceback: str | None = None
    seconds: float = 0.0


def run_step(task: Task) -> Outcome:
    """Run a task and store its result; an error of any kind becomes part of the outcome."""
    temporary = task.temporary.with_name(f"{task.temporary.name}-{uuid.uuid4().hex[:8]}")
    task = msgspec.structs.replace(task, temporary=temporary)  # Another try of it may still be ending elsewhere.
    meter = Meter()
    store = Store(task.store)
    events = Events(task.events)
    try:
        _compute(task, store, events)
        files = finish_tree(temporary)
        cost = meter.read(task.code.threads, min(task.code.cores, usable_cores()))
        entry = Entry(hash_of(files), task.record, files, cost, events.warnings)
        store.add_tree(entry, temporary, events.report)
        store.set_key(entry)
        shutil.rmtree(store.unfinished / task.key, ignore_errors=True)
        return Outcome(output=entry.output, seconds=cost["seconds"])
    except BaseException as error:
        shutil.rmtree(temporary, ignore_errors=True)  # makes room for a log on a full disk
        if known := error if isinstance(error, InputError) else disk_error(error, temporary.parent):
            return Outcome(error=str(known))
        return Outcome(error=f"{type(error).__name__}: {error}", traceback=traceback.format_exc())


def load_stage(code: StageCode) -> ModuleType:
    """Import a stage's module from the project and set the threads of the libraries that it loads."""
    if str(code.root) not in sys.path:
        sys.path.insert(0, str(code.root))
    module = importlib.import_module(f"{code.package}.{code.stage}")
    restore_sigterm()
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(code.threads)
    if "OpenImageIO" in sys.modules:
        sys.modules["OpenImageIO"].attribute("threads", code.threads)
    return module


def convert_params(module: ModuleType, code: StageCode) -> msgspec.Struct:
    """Convert the parameters to the stage's own struct; InputError if one is out of its range."""
    return convert(code.params, module.Params, code.settings, f"stages.{code.stage}.params")


def check_params(code: StageCode) -> None:
    """Raise InputError if a parameter is out of its range, or if the stage's own `check(params)` does."""
    module = load_stage(code)
    getattr(module, "check", lambda _: None)(convert_params(module, code))


def threaded_map(cores: int, function: Callable, items: Iterable) -> list:
    """Apply a function to the items on `cores` threads and return all results in order."""
    if cores == 1:
        return serial_map(function, items)
    with ThreadPoolExecutor(cores) as pool:
        return list(pool.map(function, items))


def _compute(task: Task, store: Store, events: Events) -> None:
    """Run the step, or copy its shipped result, into its temporary folder."""
    out = task.temporary
    if not task.forced and copy_shipped([task.code.root, LIBRARY], task.stage.shipped, task.record, out):
        return
    module = load_stage(task.code)  # takes seconds
    params = convert_params(module, task.code)
    photo = task.record["photo"]
    out.mkdir()  # Not its parent: the folder of a run that has ended must not come back.
    _check_code(task, store)
    results = {folder: stamps_of(folder) for folder in task.folders.values() if folder.is_relative_to(task.store)}
    files = {field.removeprefix("file:"): path for field, path in task.files.items()}
    map_ = partial(threaded_map, min(task.code.cores, usable_cores()))
    inputs = Inputs(task.folders, task.facts, files, photo, map_, task.log, store.unfinished / task.key)
    try:
        module.main(params, inputs, out, events.progress)
    finally:
        _check_inputs(task, results)  # A missing or edited file is no defect of the stage.
    _check_code(task, store)
    promised = [*task.stage.makes, *(["{photo}.json"] if task.stage.gather else [])] or ["**/*"]
    for pattern in (text.replace("{photo}", photo or "") for text in promised):
        if not any(path.is_file() for path in out.glob(pattern)):
            raise FileNotFoundError(f"the stage {task.code.stage!r} did not write {pattern}")


def _check_inputs(task: Task, results: dict[Path, dict[str, Stamp]]) -> None:
    """Raise InputError if someone replaced a photo or edited a result while the step read it."""
    changed = [p for name, p in task.files.items() if not p.is_file() or hash_of_file(p) != task.record[name]]
    for folder, before in results.items():
        after = stamps_of(folder)
        changed += [folder / name for name in sorted(before.keys() | after) if before.get(name) != after.get(name)]
    if changed:
        cure = "run again: the affected results are made again"
        raise InputError("the file changed while it was being read", file=changed[0], cure=cure)


def _check_code(task: Task, store: Store) -> None:
    """Raise InputError if the sources and package data are not those of the key."""
    code = task.code
    closure = Sources([code.root, LIBRARY], store.hashes).closure(code.package, code.stage, code.settings)
    before = {name: value for name, value in task.record.items() if name.startswith(CODE)}
    if changes := difference(before, closure.record):
        names = sorted(name for name in closure.files if before.get(name) != closure.record[name])
        fault = f"the code changed while the run went on ({'; '.join(changes)})"
        cure = "run again; a worker of a cluster needs the same checkout and the same packages"
        raise InputError(fault, file=", ".join(str(closure.files[name]) for name in names) or None, cure=cure)


class Meter:
    """Meter of wall and processor seconds since its creation, and of peak memory."""

    def __init__(self) -> None:
        with contextlib.suppress(OSError), open("/proc/self/clear_refs", "w") as stream:  # Linux resets the peak.
            stream.write("5")
        self.started = datetime.datetime.now(datetime.UTC).isoformat(timespec="milliseconds")
        self.wall = time.perf_counter()
        self.cpu = _cpu_seconds()

    def read(self, threads: int = 1, cores: int = 1) -> dict[str, Any]:
        """Return wall and processor seconds, peak memory in MB (2^20 bytes), and facts of the machine."""
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10
        with contextlib.suppress(OSError), open("/proc/self/status") as stream:
            peak = next(int(line.split()[1]) / 2**10 for line in stream if line.startswith("VmHWM"))
        facts = {"system": platform.system(), "processor": platform.machine(), "cores": os.cpu_count()}
        return {
            "started": self.started,
            "seconds": round(time.perf_counter() - self.wall, 3),
            "cpu_seconds": round(_cpu_seconds() - self.cpu, 3),
            "memory_mb": round(peak, 1),
            "threads": threads,
            "cores": cores,
            "machine": facts | {"python": platform.python_version()},
        }


def _cpu_seconds() -> float:
    usage = map(resource.getrusage, (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(each.ru_utime + each.ru_stime for each in usage)


class Events(logging.Handler):
    """Progress and warnings of one step, as JSON lines of a file that the parent reads meanwhile.

    It receives the warnings of the library and of Python, in place of all other handlers.

    Attributes:
        warnings: each text once
    """

    def __init__(self, path: Path):
        super().__init__(logging.WARNING)
        self.path = path
        self.warnings: list[str] = []
        self._time = 0.0
        logging.captureWarnings(True)
        warnings.simplefilter("ignore", DeprecationWarning)
        for logger in map(logging.getLogger, ("factorlib", "py.warnings")):
            logger.handlers = [self]
            logger.propagate = False

    def emit(self, record: logging.LogRecord) -> None:
        """Write a warning to the file of events, and remember it for the result."""
        text = record.getMessage().strip()
        if text not in self.warnings:
            self.warnings.append(text)
            self.report(text)

    def progress(self, done: float, total: float, text: str = "") -> None:
        """Report that `done` of `total` is done; a report within INTERVAL seconds of the last is dropped."""
        if (now := time.monotonic()) - self._time >= INTERVAL:
            self._time = now
            self._write({"done": float(done), "total": float(total), "text": text})

    def report(self, text: str) -> None:
        """Write a warning to the file of events alone, not to the log of the result."""
        self._write({"warning": text})

    def _write(self, event: dict) -> None:
        with contextlib.suppress(OSError):  # On a full disk the step itself fails, or finds room again.
            append_text(self.path, json.dumps(event) + "\n")


# ── processes ────────────────────────────────────────────────────────────────────────────────────────────────────────

THREAD_VARIABLES = [f"{library}_NUM_THREADS" for library in ("OMP", "MKL", "OPENBLAS", "NUMEXPR")]
THREAD_VARIABLES += ["VECLIB_MAXIMUM_THREADS"]
FIXED = {
    "PYTHONHASHSEED": "0",
    "PYTHONWARNINGS": "ignore:resource_tracker",  # Python reports semaphores of a killed run as leaked.
    "OMP_WAIT_POLICY": "PASSIVE",  # Threads that wait by spinning slow down others.
}
TRIM = "MALLOC_TRIM_THRESHOLD_"  # Dask's nanny sets it; sums of 700 × 700 numbers then take three times as long.
WATCH = 0.3  # seconds between two checks that the run goes on
PATIENCE = 10  # seconds to reach a scheduler
AHEAD = 200  # most steps submitted to a cluster at a time; each holds an open lock file
TRIES = 3  # of a step whose process or worker dies, on a cluster
_starting = threading.Lock()  # held while a process starts, because the environment is changed
_this_thread = threading.local()  # the process of a thread, and its run and number of threads


class Workers:
    """Executor of steps, each in a process: on this machine, or on the workers of a Dask scheduler.

    Attributes:
        capacity: number of cores (of a cluster: of steps) that may be busy at once

    Raises:
        InputError: No scheduler answers, or Dask is not installed.
    """

    def __init__(self, address: str = "processes", run: Path | None = None, report: Callable[[str], None] = print):
        self.run = run
        self.client = None
        self._busy: dict[Future, int] = {}
        if address == "processes":
            self.capacity = usable_cores()
            self._executor: Any = ThreadPoolExecutor(self.capacity)
        else:
            self.capacity = AHEAD
            self.client = connect(address)
            self._executor = self.client.get_executor(pure=False, retries=TRIES - 1)
            report(f"steps go to {address} and wait there for a worker: .venv/bin/dask worker {address}")

    def free(self, cores: int) -> bool:
        """Return True if a step of `cores` cores may start: they are free, or no other step runs."""
        self._busy = {future: count for future, count in self._busy.items() if not future.done()}
        return not self._busy or sum(self._busy.values()) + (1 if self.client else cores) <= self.capacity

    def submit(self, cores: int, threads: int, function: Callable, argument: Any) -> Future:
        """Start `function(argument)` in a process of `threads` threads, which takes `cores` cores."""
        future = self._executor.submit(compute_in_process, self.run, threads, function, argument)
        self._busy[future] = 1 if self.client else cores
        return future

    def close(self) -> None:
        """End the processes: at once if the run's lock is free, else after the steps that they run."""
        if self.client is None:
            return self._executor.shutdown()
        if not all(future.done() for future in self._busy):
            time.sleep(2 * WATCH)
        self._executor.shutdown(wait=False)
        self.client.close()


def usable_cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def connect(scheduler: str) -> Any:
    """Return a Dask client; InputError if Dask is not installed or no scheduler answers."""
    if find_spec("distributed") is None:
        cure = "install it: make setup EXTRAS=dask, or, in the checkout, pip install '.[dask]'"
        raise InputError("Dask is not installed", key="executor", cure=cure)
    from distributed import Client

    for name in ("distributed", "distributed.client", "distributed.core", "distributed.comm"):
        logging.getLogger(name).setLevel(logging.CRITICAL)  # The outcome of a step reports a lost connection.
    try:
        return Client(scheduler, timeout=PATIENCE, set_as_default=False)
    except Exception as error:  # Anything may answer there, such as an HTTP server.
        cure = "start one: dask scheduler --port 8786; or leave the executor out, for processes of this machine"
        fault = f"no Dask scheduler answers at {scheduler} ({str(error) or f'nothing in {PATIENCE} s'})"
        raise InputError(fault, key="executor", cure=cure) from error


def compute_in_process(run: Path | None, threads: int, function: Callable, argument: Any) -> Any:
    """Compute `function(argument)` in the process of this thread, which is started for a run and number of threads.

    Raises:
        InputError: This machine does not have the run's folder.
    """
    if run is not None and not run.is_dir():
        cure = "keep build/ and the data on a file system that all machines mount at the same path"
        raise InputError(f"the worker on {os.uname().nodename} does not see the run's folder", file=run, cure=cure)
    if getattr(_this_thread, "started_for", None) != (run, threads):
        _this_thread.pool = _start_process(run, threads)
        _this_thread.started_for = (run, threads)
    try:
        return _this_thread.pool.submit(function, argument).result()
    except BrokenProcessPool:
        _this_thread.started_for = None
        raise


def _start_process(run: Path | None, threads: int) -> ProcessPoolExecutor:
    """Start a process in an environment that fixes the order of sets and the threads of libraries."""
    multiprocessing.current_process().daemon = False  # A process of Dask's nanny may start none.
    pool = ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), _begin_process, (run,))
    with _starting:
        before = dict(os.environ)
        os.environ.update(FIXED | dict.fromkeys(THREAD_VARIABLES, str(threads)))
        os.environ.pop(TRIM, None)
        try:
            resource_tracker.ensure_running()  # It unblocks SIGINT.
            signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # The process inherits that: it never gets one.
            pool.submit(os.getpid)
        finally:
            os.environ.clear()
            os.environ.update(before)
    return pool


def _begin_process(run: Path | None) -> None:
    """Begin a process: it ignores signals, and ends with its parent or with its run."""
    signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT, signal.SIGTERM))  # COLMAP replaces a handler, not this
    parent = multiprocessing.parent_process()

    def end_with_parent_and_run() -> None:
        """End this process once its parent is gone, or the run that it works for."""
        while parent is not None and parent.is_alive() and (run is None or is_locked(run / LOCK)):
            time.sleep(WATCH)
        os._exit(1)

    threading.Thread(target=end_with_parent_and_run, daemon=True).start()
