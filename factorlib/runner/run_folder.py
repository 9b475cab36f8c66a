"""Folders of runs in store/tmp, for unfinished results.

Each run holds a lock in its folder while it lives.  The operating system frees the lock of a killed run, so its folder
can be deleted, and there is no unlock command.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import time
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from factorlib.errors import InputError
from factorlib.runner.store import Store, is_locked, lock

if TYPE_CHECKING:
    from filelock import BaseFileLock

LOCK = "lock"  # in the folder of a run, which holds it
ABANDONED = 86400.0  # seconds without a change after which a draft outside a run is of a killed process
ENDING = 10.0  # most seconds that processes of a cluster take to end with their run
PAUSE = 0.05  # seconds between two tries to delete a folder


def begin_run(store: Store) -> tuple[Path, BaseFileLock]:
    """Create a run's folder for unfinished results, and return it with the lock in it that shows that the run lives."""
    folder = store.tmp / f"run-{os.getpid()}-{uuid.uuid4().hex[:8]}"
    with _entrance(store):
        return folder, lock(folder / LOCK)


def end_run(folder: Path) -> None:
    """Delete a run's folder; processes of a cluster that end with the run may still write to it for a moment."""
    end = time.monotonic() + ENDING
    while folder.exists() and time.monotonic() < end:
        shutil.rmtree(folder, ignore_errors=True)
        time.sleep(PAUSE if folder.exists() else 0.0)


@contextlib.contextmanager
def no_runs(store: Store) -> Iterator[None]:
    """Keep runs from starting while the code inside deletes results; InputError if a run is going on."""
    with _entrance(store):
        if any(is_locked(folder / LOCK) for folder in store.tmp.iterdir()):
            raise InputError("a run is using this store", file=store.root, cure="wait until it has ended")
        yield


@contextlib.contextmanager
def _entrance(store: Store) -> Iterator[None]:
    """Admit one command at a time; the folders of killed runs are deleted first."""
    store.tmp.mkdir(parents=True, exist_ok=True)
    with lock(store.root / "door.lock", wait=True):
        _remove_killed_runs(store.tmp)
        yield


def _remove_killed_runs(folder: Path) -> None:
    """Delete the folders of runs whose lock is free, and drafts without a change for a day."""
    for path in (path for path in folder.iterdir() if path.is_dir() and not is_locked(path / LOCK)):
        with contextlib.suppress(FileNotFoundError):
            if path.name.startswith("run-") or time.time() - path.stat().st_mtime > ABANDONED:
                shutil.rmtree(path, ignore_errors=True)
