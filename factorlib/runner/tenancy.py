"""Who is using the store: runs that go on, and what dead ones left behind.

Each run has a folder in store/tmp and holds a lock on it while it lives; the operating system frees the lock of a run
that was killed, so a folder whose lock can be taken is rubbish, and no command is needed to unlock anything.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path

from filelock import FileLock, Timeout

from factorlib.errors import InputError
from factorlib.runner.leftover import is_alive, sweep_drafts
from factorlib.runner.store import Store


@contextlib.contextmanager
def tenant(store: Store, say: Callable[[str], None]) -> Iterator[Path]:
    """A run's own folder for what it has not finished; gone afterwards, with everything that dead runs left."""
    name = f"run-{os.getpid()}-{uuid.uuid4().hex[:8]}"
    folder, lock = store.tmp / name, FileLock(store.tmp / f"{name}.lock")
    store.locks.mkdir(parents=True, exist_ok=True)
    with _door(store, say):
        sweep(store)
        lock.acquire()
        folder.mkdir(parents=True)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        lock.release()
        Path(lock.lock_file).unlink(missing_ok=True)


@contextlib.contextmanager
def alone(store: Store) -> Iterator[None]:
    """For what deletes results: no run goes on, and none starts meanwhile."""
    store.tmp.mkdir(parents=True, exist_ok=True)
    with _door(store, lambda _: None):
        sweep(store)
        if any(store.tmp.glob("run-*.lock")):
            raise InputError("a run is going on", file=store.root, cure="wait until it has ended")
        yield


@contextlib.contextmanager
def _door(store: Store, say: Callable[[str], None]) -> Iterator[None]:
    store.tmp.mkdir(parents=True, exist_ok=True)
    door = FileLock(store.root / "door.lock")
    try:
        door.acquire(timeout=0.5)
    except Timeout:
        say("waiting: the store is being cleaned by another command")
        door.acquire()
    try:
        yield
    finally:
        door.release()


def sweep(store: Store) -> None:
    """Delete what dead runs left in tmp, and their drafts of keys, logs and caches."""
    for lock_file in store.tmp.glob("run-*.lock"):
        lock = FileLock(lock_file)
        try:
            lock.acquire(timeout=0)
        except Timeout:
            continue
        shutil.rmtree(lock_file.with_suffix(""), ignore_errors=True)
        lock.release()
        lock_file.unlink(missing_ok=True)
    for folder in (store.keys, store.logs, store.cache):
        sweep_drafts(folder)
    alive = {path.stem for path in store.tmp.glob("run-*.lock")}
    for path in store.tmp.iterdir():
        if path.is_dir() and path.name not in alive and not _maker_lives(path.name):
            shutil.rmtree(path, ignore_errors=True)


def _maker_lives(name: str) -> bool:
    """Whether the process that a draft is named for, `view-<pid>-…`, still is."""
    kind, _, rest = name.partition("-")
    pid = rest.partition("-")[0]
    return kind == "view" and pid.isdigit() and is_alive(int(pid))
