"""What runs in a worker of a Dask cluster: it hands each task to a child process of its own (`factorlib.runner.child`).

The children of a run are kept for its later tasks, by their number of threads, and end with it.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

from distributed import Worker, get_worker, secede

from factorlib.runner.child import Child

_lock = threading.Lock()
_spare: dict[tuple[Path, int], list[Child]] = {}
_busy: dict[Child, Path] = {}


def hosted(run: Path, threads: int, waits: bool, function: Callable, *arguments: Any) -> Any:
    """`function(address of the scheduler, *arguments)` in a child with `threads` threads, for the run of that folder.

    waits: it mostly waits for other tasks, so the worker takes on others meanwhile
    """
    worker = get_worker()
    key = worker.get_current_task()
    if waits:
        secede()
    with _child(run, threads) as child:
        return child.call(lambda: _wanted(worker, key), function, worker.scheduler.address, *arguments)


def busy(run: Path) -> int:
    """How many tasks of a run have a child here."""
    with _lock:
        return sum(of == run for of in _busy.values())


@contextlib.contextmanager
def _child(run: Path, threads: int) -> Any:
    with _lock:
        for old in [of for of in _spare if not of[0].is_dir()]:
            for child in _spare.pop(old):
                child.kill()
        spare = _spare.get((run, threads))
        child = spare.pop() if spare else None
    child = child if child and child.process.poll() is None else Child(threads, run)
    with _lock:
        _busy[child] = run
    try:
        yield child
    except BaseException:
        child.kill()
        raise
    else:
        with _lock:
            _spare.setdefault((run, threads), []).append(child)
    finally:
        with _lock:
            del _busy[child]


def _wanted(worker: Worker, key: str) -> bool:
    """False once the task is cancelled, which for Dask is a change of its state, no interruption; or the worker closes."""
    task = worker.state.tasks.get(key)
    return (
        task is not None
        and task.state != "cancelled"
        and worker.status.name in ("running", "paused", "closing_gracefully")
    )
