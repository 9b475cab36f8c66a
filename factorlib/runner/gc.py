"""Taking away: what killed runs left, results that no dataset's last run needs, and a dataset's results.

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

import msgspec
from filelock import FileLock, Timeout

from factorlib.errors import InputError
from factorlib.runner.home import Home, made_homes
from factorlib.runner.plan import Step
from factorlib.runner.project import Project
from factorlib.runner.store import Store, is_alive, sweep_drafts

Gone = tuple[list[Path], list[Path]]  # what was deleted, and what is left beside it, for the runner did not make it
LEFT_OVER = "left over"  # what was damaged, and files without a key
INPUT = "input:"  # of the fields of a record, those that name a result it was made from


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


# ── results ──────────────────────────────────────────────────────────────────────────────────────────────────────────


class Freed(msgspec.Struct, frozen=True):
    """How many results were deleted, and how many bytes that freed."""

    results: int
    bytes: int


class Unneeded(msgspec.Struct, frozen=True):
    """Results of one stage that no dataset's last run needs.

    bytes: of files that nothing else needs;  oldest, newest: when they were kept, seconds since 1970
    """

    stage: str
    results: int
    bytes: int
    oldest: float
    newest: float


def unneeded(project: Project) -> list[Unneeded]:
    """What `collect` would delete now, by stage, the largest first; what has no stage any more is `left over`."""
    store = Store(project.build / "store")
    keys, trees, _ = _dead(project, store)
    sizes = {path.name: _size(path) for path in trees}
    found: dict[str, list[tuple[float, int]]] = {}
    for path in keys:
        entry = store.entry(path.stem)
        stage = entry.record.get("stage", LEFT_OVER) if entry else LEFT_OVER
        found.setdefault(stage, []).append((path.stat().st_mtime, sizes.pop(entry.output, 0) if entry else 0))
    if sizes:
        kept = [(path.stat().st_mtime, sizes[path.name]) for path in trees if path.name in sizes]
        found.setdefault(LEFT_OVER, []).extend(kept)
    groups = [
        Unneeded(s, len(r), sum(b for _, b in r), min(t for t, _ in r), max(t for t, _ in r)) for s, r in found.items()
    ]
    return sorted(groups, key=lambda group: (-group.bytes, group.stage))


def collect(project: Project) -> Freed:
    """Delete every result that is not current for some dataset, nor what such a one was made from; refused while a run goes on."""
    store = Store(project.build / "store")
    with alone(store):
        keys, trees, rest = _dead(project, store)
        freed = sum(_size(path) for path in trees)
        for path in keys + trees + rest:
            _delete(path, store.tmp / f"gc-{os.getpid()}-{path.name}")
    return Freed(len(keys), freed)


def _delete(path: Path, aside: Path) -> None:
    """A folder goes from its place by one rename: where this is killed, no part of it is taken for a result that is damaged."""
    if path.is_dir() and not path.is_symlink():
        os.rename(path, aside)
        shutil.rmtree(aside)
    else:
        path.unlink()


def _dead(project: Project, store: Store) -> tuple[list[Path], list[Path], list[Path]]:
    """What may go from a store: files of keys, trees of results, and everything else."""
    homes = [Home(path) for path in project.build.glob("*") if path.is_dir() and path.name != "store"]
    keys = _needed(store, {key for home in homes for key in home.keys().values()})
    trees = {entry.output for key in keys if (entry := store.entry(key))}
    views = {Path(link.readlink()).name for home in homes for link in home.folder.glob("*") if link.is_symlink()}
    unused = [p for p in store.keys.glob("*") if p.stem not in keys or p.suffix != ".json"]
    rest = [p for p in store.views.glob("*") if p.name not in views]  # they only link to trees
    rest += [p for p in store.logs.glob("*") if p.stem not in keys or p.suffix != ".jsonl"]
    rest += [*store.locks.glob("*"), *store.unfinished.glob("*")]
    return unused, [p for p in store.trees.glob("*") if p.name not in trees] + list(store.damaged.glob("*")), rest


def _needed(store: Store, current: set[str]) -> set[str]:
    """Those keys, and of every result that they were made from, however far, the keys that gave it.

    A step whose result is current is current only as long as what it was made from is there, though another run may have made
    that anew in the meantime, with other parameters.
    """
    entries = {path.stem: entry for path in store.keys.glob("*.json") if (entry := store.entry(path.stem))}
    gave: dict[tuple[str, str], list[str]] = {}
    for key, entry in entries.items():
        gave.setdefault((_step(entry.record), entry.output), []).append(key)
    found, stack = set(current), list(current)
    while stack:
        record = entries[key].record if (key := stack.pop()) in entries else {}
        above = {
            other
            for name, output in record.items()
            if name.startswith(INPUT)
            for other in gave.get((name.removeprefix(INPUT), output), [])
        }
        stack += above - found
        found |= above
    return found


def _step(record: dict) -> str:
    return str(Step(record.get("stage", LEFT_OVER), record.get("photo"), record.get("recipe")))


def forget(project: Project, home: Home) -> Gone:
    """Delete a dataset's links and marks; what they led to in the store goes with the next gc."""
    with alone(Store(project.build / "store")):
        return _forget(project, home)


def forget_all(project: Project) -> Gone:
    """Delete every dataset's links and marks, and the store; what else lies in build/ stays."""
    if not project.build.is_dir():
        return [], []
    store = Store(project.build / "store")
    with alone(store):
        parts = [_forget(project, home) for home in made_homes(project)]
        deleted, left = ([path for part in parts for path in part[which]] for which in (0, 1))
        if not store.root.is_symlink():
            shutil.rmtree(store.root)
            deleted.append(store.root)
        left += [path for path in sorted(project.build.iterdir()) if not any(path in below.parents for below in left)]
    return deleted, left


def _forget(project: Project, home: Home) -> Gone:
    """Only what the runner put there, the mark last; a link is deleted, what it leads to is not touched."""
    folders = [
        folder
        for folder in home.folder.iterdir()
        if folder.is_dir() and not folder.is_symlink() and folder != home.errors
    ]
    pictures = [path for folder in folders for path in folder.iterdir() if _is_link_to_result(path)]  # of recipes
    ours = [path for path in home.folder.iterdir() if _is_link_to_result(path)] + pictures
    ours += [path for path in (home.keys_file, home.log) if path.is_symlink() or path.is_file()]
    ours += sorted(home.folder.glob(".current.*"))
    if not home.errors.is_symlink():
        ours += sorted(home.errors.glob("*.txt"))
    for path in (*ours, home.mark):
        path.unlink()
    for folder in (*dict.fromkeys(path.parent for path in pictures), home.errors, home.folder):
        with contextlib.suppress(OSError):  # not there, a link, or with something in it
            folder.rmdir()
    left = sorted(home.folder.iterdir()) if home.folder.is_dir() else []
    return [home.folder] if not left else [*ours, home.mark], left


def _is_link_to_result(path: Path) -> bool:
    return path.is_symlink() and os.readlink(path).startswith(("../store/", "../../store/"))


def _size(path: Path) -> int:
    return sum(file.stat().st_size for file in path.rglob("*") if file.is_file())
