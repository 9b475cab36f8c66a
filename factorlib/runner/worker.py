"""Steps in processes: of this machine, or of the workers of a Dask cluster.

How many threads a library uses, and in which order sets are walked, is fixed when a process starts, and results depend
on it. So each process is started for one number of threads, in an environment of its own, with the modules that are on
disk now, and runs one step at a time: a library that crashes, or a step that is killed for want of memory, ends that
process alone. A process ends with the one that started it, and with its run, whose lock it watches.

A task carries keys and paths, never arrays, and whatever happens comes back as an `Outcome`: an executor needs no more
than `submit`.  While it runs a step says how far it is, and what it warns of, in a file of events.
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
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from importlib.util import find_spec
from multiprocessing import resource_tracker
from pathlib import Path
from types import ModuleType
from typing import Any, Self

import msgspec

from factorlib.errors import InputError
from factorlib.runner.closure import CODE, Sources
from factorlib.runner.plan import difference
from factorlib.runner.project import LIBRARY, Code, Stage, take_sigterm_back
from factorlib.runner.store import (
    LOCK,
    Entry,
    FileHashes,
    Stamp,
    Store,
    copy_shipped,
    hash_of_file,
    is_locked,
    stamps_of,
)
from factorlib.stage import Inputs, serial_map
from factorlib.wholefile import append_text, disk_error, replace_file
from factorlib.yamlfile import convert

EVERY = 0.2  # seconds between two words of progress


class Task(msgspec.Struct, frozen=True):
    """Description of a step for a worker.

    files:   by the name that the record has for each, whose hash it holds
    forced:  make it, whatever ships with the source
    """

    code: Code
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
    """Result of a step that ended.

    output: hash of what was made;  error: what went wrong;  traceback: of a defect, None where a user can mend it
    code_changed: whether the stage's code is another than that of the key, so that further steps of it would fail alike
    """

    output: str | None = None
    error: str | None = None
    traceback: str | None = None
    code_changed: bool = False
    seconds: float = 0.0


class CodeChanged(InputError):
    """The code of a stage was edited while the run went on."""


def run_step(task: Task) -> Outcome:
    """Run a task and keep its result in the store.  Raises nothing: an error of any kind is part of the outcome."""
    temporary = task.temporary.with_name(f"{task.temporary.name}-{uuid.uuid4().hex[:8]}")
    task = msgspec.structs.replace(task, temporary=temporary)  # another try of it may still be ending elsewhere
    meter, code, store = Meter(), task.code, Store(task.store)
    with Events(task.events) as events:
        try:
            entry = _made(task, store, events)
            where: dict[str, Any] = {name: task.record[name] for name in ("photo", "recipe") if name in task.record}
            where |= {"stage": code.stage, "key": task.key}
            lines = [where | {"event": "warning", "text": text} for text in events.warnings]
            lines.append(where | {"event": "done", **meter.read(code.threads, min(code.cores, usable_cores()))})
            store.logs.mkdir(parents=True, exist_ok=True)
            text = "".join(json.dumps(line, sort_keys=True) + "\n" for line in lines)
            replace_file(store.log(task.key), text.encode())
            store.keep(task.key, entry)
            shutil.rmtree(store.unfinished / task.key, ignore_errors=True)
            return Outcome(output=entry.output, seconds=meter.read()["seconds"])
        except BaseException as error:  # whatever it is, the parent reports it
            shutil.rmtree(task.temporary, ignore_errors=True)  # on a full disk there is room for a log then
            if known := error if isinstance(error, InputError) else disk_error(error, task.temporary.parent):
                return Outcome(error=str(known), code_changed=isinstance(known, CodeChanged))
            return Outcome(error=f"{type(error).__name__}: {error}", traceback=traceback.format_exc())


def load_stage(code: Code) -> ModuleType:
    """Import a stage's module from the project; what was loaded with it has the stage's threads."""
    if str(code.root) not in sys.path:
        sys.path.insert(0, str(code.root))
    module = importlib.import_module(f"{code.package}.{code.stage}")
    take_sigterm_back()
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(code.threads)
    if "OpenImageIO" in sys.modules:
        sys.modules["OpenImageIO"].attribute("threads", code.threads)
    return module


def params_of(code: Code) -> msgspec.Struct:
    """Convert the stage's parameters to its own struct.  Raises InputError where one is out of its bounds."""
    return convert(code.params, load_stage(code).Params, code.settings, f"stages.{code.stage}.params")


def check_params(code: Code) -> None:
    """Raise InputError if a parameter of a stage is out of its bounds, or if the stage's own `check(params)` does."""
    params = params_of(code)
    if check := getattr(load_stage(code), "check", None):
        check(params)


def spread(cores: int, function: Callable, items: Iterable) -> list:
    """Apply the function to every item, in order, on so many threads."""
    if cores == 1:
        return serial_map(function, items)
    with ThreadPoolExecutor(cores) as pool:
        return list(pool.map(function, items))


def _made(task: Task, store: Store, events: Events) -> Entry:
    """Run the step, or copy its shipped result; its tree is in the store afterwards, its key is not."""
    roots = [task.code.root, LIBRARY]
    if not task.forced and copy_shipped(roots, task.stage.shipped, task.record, task.temporary):
        return store.take_in(task.record, task.temporary, events.say)
    module, params = load_stage(task.code), params_of(task.code)  # which takes seconds
    photo, out = task.record["photo"], task.temporary
    out.mkdir(parents=True)
    hashes = FileHashes(store.cache / "files.json")
    _check_code(task, hashes)
    results = {folder: stamps_of(folder) for folder in task.folders.values() if folder.is_relative_to(task.store)}
    unfinished = store.unfinished / task.key
    files = {field.removeprefix("file:"): path for field, path in task.files.items()}
    map_ = partial(spread, min(task.code.cores, usable_cores()))
    inputs = Inputs(task.folders, task.facts, files, photo, map_, task.log, unfinished)
    try:
        module.main(params, inputs, out, events.progress)
    except Exception:
        _check_inputs(task, results)  # of a file that was taken away or edited meanwhile: no defect of the stage
        raise
    _check_inputs(task, results)
    _check_code(task, hashes)
    promised = [*task.stage.makes, *(["{photo}.json"] if task.stage.gather else [])] or ["**/*"]
    for pattern in (text.replace("{photo}", photo or "") for text in promised):
        if not any(path.is_file() for path in out.glob(pattern)):  # to break its word is a defect
            raise FileNotFoundError(f"the stage {task.code.stage!r} made no {pattern}")
    return store.take_in(task.record, out, events.say)


def _check_inputs(task: Task, results: dict[Path, dict[str, Stamp]]) -> None:
    """Somebody may replace a photo, or open a file of build/<dataset>/ in an editor, while it is read."""
    changed = [p for name, p in task.files.items() if not p.is_file() or hash_of_file(p) != task.record[name]]
    for folder, before in results.items():
        now = stamps_of(folder)
        changed += [folder / name for name in sorted(before.keys() | now.keys()) if before.get(name) != now.get(name)]
    if changed:
        cure = "run again: what is needed is made again"
        raise InputError("the file changed while it was being read", file=changed[0], cure=cure)


def _check_code(task: Task, hashes: FileHashes) -> None:
    """Check that the key's code is the code there is: the source of every module, and the package data."""
    code = task.code
    closure = Sources([code.root, LIBRARY], hashes).closure(code.package, code.stage, code.settings)
    now, before = closure.record, {n: value for n, value in task.record.items() if n.startswith(CODE)}
    if now != before:
        changed = [name for name in sorted(before.keys() | now.keys()) if before.get(name) != now.get(name)]
        files = [str(closure.files[name]) for name in changed if name in closure.files]
        words = f"the code changed while the run went on ({'; '.join(difference(before, now))})"
        cure = "run again; a worker of a cluster needs the same checkout and the same packages"
        raise CodeChanged(words, file=", ".join(files) or None, cure=cure)


class Meter:
    """Meter of wall and processor seconds since it was made, and the most memory."""

    def __init__(self) -> None:
        with contextlib.suppress(OSError), open("/proc/self/clear_refs", "w") as stream:  # Linux counts the peak anew
            stream.write("5")
        self.started = datetime.datetime.now(datetime.UTC).isoformat(timespec="milliseconds")
        self.wall, self.cpu = time.perf_counter(), _cpu_seconds()

    def read(self, threads: int = 1, cores: int = 1) -> dict[str, Any]:
        """Wall and processor seconds, peak memory in MB (2^20 bytes), and facts of the machine."""
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (2**20 if platform.system() == "Darwin" else 2**10)
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
    return sum(one.ru_utime + one.ru_stime for one in usage)


class Events(logging.Handler):
    """Progress and warnings of one step, as JSON lines of a file that the parent reads while it runs.

    Within, what the library and Python warn of comes here alone.  warnings: each text once
    """

    LOGGERS = ("factorlib", "py.warnings")

    def __init__(self, path: Path):
        super().__init__(logging.WARNING)
        self.path = path
        self.warnings: list[str] = []
        self._last = 0.0
        self._share = 0.0

    def __enter__(self) -> Self:
        logging.captureWarnings(True)
        warnings.simplefilter("ignore", DeprecationWarning)
        for logger in map(logging.getLogger, self.LOGGERS):
            logger.addHandler(self)
            logger.propagate = False
        return self

    def __exit__(self, *exception: object) -> None:
        for logger in map(logging.getLogger, self.LOGGERS):
            logger.removeHandler(self)

    def emit(self, record: logging.LogRecord) -> None:
        """Take note of a warning (as a `logging.Handler`)."""
        text = record.getMessage().strip()
        if text not in self.warnings:
            self.warnings.append(text)
            self.say(text)

    def progress(self, done: float, total: float, text: str = "") -> None:
        """Report that `done` of `total` is done.

        A report within EVERY seconds of the last is dropped, unless the share has changed by a hundredth.
        """
        share = done / total if total else 0.0
        if (now := time.monotonic()) - self._last >= EVERY or abs(share - self._share) >= 0.01:
            self._last, self._share = now, share
            self._write({"done": float(done), "total": float(total), "text": text})

    def say(self, text: str) -> None:
        """Report a warning, whether or not it is part of the result's log."""
        self._write({"warning": text})

    def _write(self, event: dict) -> None:
        with contextlib.suppress(OSError):  # on a full disk: the step itself fails there, or finds room again
            append_text(self.path, json.dumps(event) + "\n")


# ── processes ────────────────────────────────────────────────────────────────────────────────────────────────────────

THREAD_VARIABLES = [
    "OMP_NUM_THREADS",
    "MKL_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "NUMEXPR_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
]
FIXED = {
    "PYTHONHASHSEED": "0",
    "PYTHONWARNINGS": "ignore:resource_tracker",  # Python reports semaphores of a run that was killed as leaked.
    "OMP_WAIT_POLICY": "PASSIVE",  # threads that wait by spinning stand in the way of others, and of each other
    "MALLOC_TRIM_THRESHOLD_": None,  # Dask's nanny sets it; sums of 700 × 700 numbers then take three times as long
}
WATCH = 0.3  # seconds between two looks at whether the run goes on
PATIENCE = 10  # seconds to reach a scheduler
AHEAD = 200  # most steps that a cluster is handed at a time: each holds an open lock file
TRIES = 3  # of a step whose process or worker dies, on a cluster
_starting = threading.Lock()  # The environment is changed while a process starts.
_of_thread = threading.local()  # the process of a thread, and the run and number of threads that it is for


class Workers:
    """Executor of steps, each in a process: on this machine, or on the workers of a Dask scheduler.

    Attributes:
        capacity: number of cores (of a cluster: of steps) that may be busy at once

    Raises:
        InputError: No scheduler answers, or Dask is not installed.
    """

    def __init__(self, where: str = "processes", run: Path | None = None, say: Callable[[str], None] = print):
        self.run, self.client = run, None
        self._busy: dict[Future, int] = {}
        if where == "processes":
            self.capacity = usable_cores()
            self._executor: Any = ThreadPoolExecutor(self.capacity)
        else:
            self.capacity = AHEAD
            self.client = connect(where)
            self._executor = self.client.get_executor(pure=False, retries=TRIES - 1)
            say(f"steps go to {where}; they wait there for a worker: .venv/bin/dask worker {where}")

    def free(self, cores: int) -> bool:
        """Return whether a step of `cores` cores may start now: the cores suffice, or nothing else runs."""
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
        cure = "make setup EXTRAS=dask, or pip install 'factorlib[dask]'"
        raise InputError("Dask is not installed", key="executor", cure=cure)
    from distributed import Client

    for name in ("distributed", "distributed.client", "distributed.core", "distributed.comm"):
        logging.getLogger(name).setLevel(logging.CRITICAL)  # The outcome of a step reports a lost connection.
    try:
        return Client(scheduler, timeout=PATIENCE, set_as_default=False)
    except Exception as error:  # Anything may answer there: an HTTP server, garbage.
        cure = "start one: dask scheduler --port 8786; or leave the executor out, for processes of this machine"
        words = f"no Dask scheduler answers at {scheduler} ({str(error) or f'nothing in {PATIENCE} s'})"
        raise InputError(words, key="executor", cure=cure) from error


def compute_in_process(run: Path | None, threads: int, function: Callable, argument: Any) -> Any:
    """Compute `function(argument)` in the process of this thread, which is started for a run and number of threads.

    Raises:
        InputError: This machine does not have the run's folder.
    """
    if run is not None and not run.is_dir():
        cure = "keep build/ and the data on a file system that all machines mount at the same path"
        raise InputError(f"the worker on {os.uname().nodename} does not see the run's folder", file=run, cure=cure)
    multiprocessing.current_process().daemon = False  # A process of Dask's nanny may start none.
    future = None
    if getattr(_of_thread, "started_for", None) == (run, threads):
        with contextlib.suppress(BrokenProcessPool):  # The process died after its last step.
            future = _of_thread.pool.submit(function, argument)
    if future is None:
        _of_thread.started_for = (run, threads)
        _of_thread.pool = ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), _begin_process, (run,))
        with _starting, _environment(FIXED | dict.fromkeys(THREAD_VARIABLES, str(threads))):
            resource_tracker.ensure_running()  # It unblocks SIGINT.
            signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # The process inherits that: it never gets one.
            future = _of_thread.pool.submit(function, argument)
    return future.result()


@contextlib.contextmanager
def _environment(values: dict[str, str | None]) -> Iterator[None]:
    """Set environment variables inside; None unsets one."""
    before = {name: os.environ.get(name) for name in values}
    try:
        _set(values)
        yield
    finally:
        _set(before)


def _set(values: dict[str, str | None]) -> None:
    os.environ.update({name: value for name, value in values.items() if value is not None})
    for name in [name for name, value in values.items() if value is None]:
        os.environ.pop(name, None)


def _begin_process(run: Path | None) -> None:
    """Begin a process: it ignores signals, and ends with its parent or with its run."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    parent = multiprocessing.parent_process()

    def end_with_parent_and_run() -> None:
        while parent is not None and parent.is_alive() and (run is None or is_locked(run / LOCK)):
            time.sleep(WATCH)
        os._exit(1)

    threading.Thread(target=end_with_parent_and_run, daemon=True).start()
