"""Looking after a store: what killed runs left, what is damaged, what no dataset needs, and forgetting a dataset's results.

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
from factorlib.runner.home import Home, made_homes
from factorlib.runner.plan import Step, key_of
from factorlib.runner.project import Project
from factorlib.runner.store import Inspector, Store, is_alive, sweep_drafts

Gone = tuple[list[Path], list[Path]]  # what was deleted, and what is left beside it, for the runner did not make it
Damage = tuple[Path, list[str], list[str]]  # where; a line for each fault; whose result, as `masks/kitchen (eames)`
LEFT_OVER = "left over"  # what was damaged, and files without a key


@contextlib.contextmanager
def tenant(store: Store, say: Callable[[str], None]) -> Iterator[Path]:
    """A run's own folder for what it has not finished; gone afterwards, with everything that dead runs left."""
    name = f"run-{os.getpid()}-{uuid.uuid4().hex[:8]}"
    folder, lock = store.tmp / name, FileLock(store.tmp / f"{name}.lock")
    store.locks.mkdir(parents=True, exist_ok=True)
    with _door(store, say):
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
    with _door(store, lambda _: None):
        if any(store.tmp.glob("run-*.lock")):
            raise InputError("a run is going on", file=store.root, cure="wait until it has ended")
        yield


@contextlib.contextmanager
def _door(store: Store, say: Callable[[str], None]) -> Iterator[None]:
    """Only one command at a time is within; what dead runs left in tmp, and their drafts of keys, logs and caches, is gone."""
    store.tmp.mkdir(parents=True, exist_ok=True)
    door = FileLock(store.root / "door.lock")
    try:
        door.acquire(timeout=0.5)
    except Timeout:
        say("waiting: the store is being cleaned by another command")
        door.acquire()
    try:
        for lock_file in store.tmp.glob("run-*.lock"):
            with contextlib.suppress(Timeout), FileLock(lock_file).acquire(timeout=0):
                shutil.rmtree(lock_file.with_suffix(""), ignore_errors=True)
                lock_file.unlink(missing_ok=True)
        for folder in (store.keys, store.logs, store.cache):
            sweep_drafts(folder)
        alive = {path.stem for path in store.tmp.glob("run-*.lock")}
        for path in store.tmp.iterdir():
            kind, pid, *_ = f"{path.name}--".split("-")
            in_use = kind == "view" and pid.isdigit() and is_alive(int(pid))  # view-<process>-…
            if path.is_dir() and path.name not in alive and not in_use:
                shutil.rmtree(path, ignore_errors=True)
        yield
    finally:
        door.release()


def unneeded(project: Project) -> dict[str, list[tuple[float, int]]]:
    """What `collect` would delete now, by stage, the largest first; what has no stage any more is `left over`.

    Of each result when it was kept, in seconds since 1970, and the bytes of files that nothing else needs.
    """
    store = Store(project.build / "store")
    keys, trees, _ = _dead(project, store)
    sizes, groups = {path.name: _size(path) for path in trees}, {}
    for path in keys:
        entry = store.entry(path.stem)
        stage = entry.record.get("stage", LEFT_OVER) if entry else LEFT_OVER
        groups.setdefault(stage, []).append((path.stat().st_mtime, sizes.pop(entry.output, 0) if entry else 0))
    for path in (path for path in trees if path.name in sizes):
        groups.setdefault(LEFT_OVER, []).append((path.stat().st_mtime, sizes[path.name]))
    return dict(sorted(groups.items(), key=lambda group: (-sum(size for _, size in group[1]), group[0])))


def collect(project: Project) -> tuple[int, int]:
    """Delete every result that is not current for some dataset, nor what such a one was made from; how many, and their bytes.

    Raises InputError while a run goes on.
    """
    store = Store(project.build / "store")
    with alone(store):
        keys, trees, rest = _dead(project, store)
        freed = sum(map(_size, trees))
        for path in keys + trees + rest:
            if (
                path.is_dir() and not path.is_symlink()
            ):  # by one rename: a part of it might be taken for a damaged result
                os.rename(path, aside := store.tmp / f"gc-{os.getpid()}-{path.name}")
                shutil.rmtree(aside)
            else:
                path.unlink()
    return len(keys), freed


def _dead(project: Project, store: Store) -> tuple[list[Path], list[Path], list[Path]]:
    """What may go from a store: files of keys, trees of results, and everything else."""
    homes = [Home(path) for path in project.build.glob("*") if path.is_dir() and path.name != "store"]
    keys = _needed(store, {key for home in homes for key in home.keys().values()})
    trees = {entry.output for key in keys if (entry := store.entry(key))}
    unused = [p for p in store.keys.glob("*") if p.stem not in keys or p.suffix != ".json"]
    rest = [p for p in store.logs.glob("*") if p.stem not in keys or p.suffix != ".jsonl"]
    rest += [*store.locks.glob("*"), *store.unfinished.glob("*")]
    return unused, [p for p in store.trees.glob("*") if p.name not in trees] + list(store.damaged.glob("*")), rest


def _needed(store: Store, current: set[str]) -> set[str]:
    """Those keys, and of every result that they were made from, however far, the keys that gave it.

    A step whose result is current is current only as long as what it was made from is there, though another run may have made
    that anew in the meantime, with other parameters.
    """
    entries = {path.stem: entry for path in store.keys.glob("*.json") if (entry := store.entry(path.stem))}
    gave: dict[tuple[str, str], set[str]] = {}
    for key, entry in entries.items():
        gave.setdefault((f"input:{_step(entry.record)}", entry.output), set()).add(key)
    needed, stack = set(current), [key for key in current if key in entries]
    while stack:
        inputs = [item for item in entries[stack.pop()].record.items() if item[0].startswith("input:")]
        above = set().union(*(gave.get(item, set()) for item in inputs)) - needed
        stack += above
        needed |= above
    return needed


def _step(record: dict) -> Step:
    return Step(record.get("stage", LEFT_OVER), record.get("photo"), record.get("recipe"))


def _size(path: Path) -> int:
    return sum(file.stat().st_size for file in path.rglob("*") if file.is_file())


def verify(store: Store, homes: list[Home], everything: bool) -> tuple[int, list[Damage]]:
    """Read the results that `homes` name, or everything in the store; how many there are, and what is damaged.

    What is damaged is no longer taken for right by its size and time: the next run makes it again.
    """
    inspector, users, damaged, trees = Inspector(store), {}, [], {}
    for home in homes:
        for step, key in home.keys().items():
            users.setdefault(key, []).append(f"{step} ({home.folder.name})")
    keys = sorted(users.keys() | ({path.stem for path in store.keys.glob("*.json")} if everything else set()))
    for key in keys:
        if (entry := inspector.entry(key)) is None:
            damaged.append((store.keys / f"{key}.json", ["missing or not readable"], users.get(key, [])))
            continue
        names = users.get(key) or [f"{_step(entry.record)} (of an earlier run)"]
        trees.setdefault(entry.output, (entry.files, []))[1].extend(names)
        if key_of(entry.record) != key:
            damaged.append((store.keys / f"{key}.json", ["its record is not the one that made the key"], names))
    for output, (files, names) in trees.items():  # every tree once, whichever keys gave it
        damaged.append((store.tree(output), inspector.thorough(output, files), names))
    inspector.save()
    return len(keys), [damage for damage in damaged if damage[1]]


def forget(project: Project, homes: list[Home]) -> Gone:
    """Delete links and marks of datasets; what they led to in the store goes with the next gc."""
    with alone(Store(project.build / "store")):
        parts = list(map(_forget, homes))
    return [path for deleted, _ in parts for path in deleted], [path for _, left in parts for path in left]


def forget_all(project: Project) -> Gone:
    """Delete every dataset's links and marks, and the store; what else lies in build/ stays."""
    if not project.build.is_dir():
        return [], []
    store = Store(project.build / "store")
    deleted, left = forget(project, made_homes(project))
    if not store.root.is_symlink():
        with alone(store):
            shutil.rmtree(store.root)
        deleted.append(store.root)
    left += [path for path in sorted(project.build.iterdir()) if not any(path in below.parents for below in left)]
    return deleted, left


def _forget(home: Home) -> Gone:
    """Only what the runner put there, the mark last; a link is deleted, what it leads to is not touched."""
    entries = list(home.folder.iterdir())
    folders = [path for path in entries if path.is_dir() and not path.is_symlink() and path != home.errors]
    pictures = [path for folder in folders for path in folder.iterdir() if _is_link_to_result(path)]  # of recipes
    ours = [path for path in entries if _is_link_to_result(path)] + pictures
    ours += [path for path in (home.keys_file, home.log) if path.is_symlink() or path.is_file()]
    ours += sorted(home.folder.glob(".current.*"))
    ours += [] if home.errors.is_symlink() else sorted(home.errors.glob("*.txt"))
    for path in (*ours, home.mark):
        path.unlink()
    for folder in (*dict.fromkeys(path.parent for path in pictures), home.errors, home.folder):
        with contextlib.suppress(OSError):  # not there, a link, or with something in it
            folder.rmdir()
    left = sorted(home.folder.iterdir()) if home.folder.is_dir() else []
    return [home.folder] if not left else [*ours, home.mark], left


def _is_link_to_result(path: Path) -> bool:
    return path.is_symlink() and os.readlink(path).startswith(("../store/", "../../store/"))
