"""Looking after a store: what killed runs left, what is damaged, what no dataset needs, and forgetting a dataset's results.

Each run has a folder in store/tmp and holds a lock in it while it lives; the operating system frees the lock of a run
that was killed, so a folder whose lock nobody holds is rubbish, and no command is needed to unlock anything.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import time
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path

from factorlib.errors import InputError
from factorlib.runner.home import Home, made_home, made_homes
from factorlib.runner.plan import Step, hash_of
from factorlib.runner.project import Project
from factorlib.runner.store import LOCK, Entry, Store, is_locked, lock, sweep

LEFT_OVER = "left over"  # what was damaged, and files without a key


def begin_run(store: Store, say: Callable[[str], None]) -> tuple[Path, int]:
    """Make a run's own folder for what it has not finished; everything that dead runs left is gone.

    Returns the folder, and the lock in it, by which others know that the run goes on.
    """
    folder = store.tmp / f"run-{os.getpid()}-{uuid.uuid4().hex[:8]}"
    store.locks.mkdir(parents=True, exist_ok=True)
    with _door(store, say):
        return folder, lock(folder / LOCK)


@contextlib.contextmanager
def alone(store: Store) -> Iterator[None]:
    """Hold the locks of what deletes results: no run goes on, and none starts meanwhile."""
    with _door(store, lambda _: None):
        if any(is_locked(folder / LOCK) for folder in store.tmp.iterdir()):
            raise InputError("a run is going on", file=store.root, cure="wait until it has ended")
        yield


@contextlib.contextmanager
def _door(store: Store, say: Callable[[str], None]) -> Iterator[None]:
    """Only one command at a time is within; what dead runs left in tmp is gone."""
    store.tmp.mkdir(parents=True, exist_ok=True)
    if (door := lock(store.root / "door.lock")) is None:
        say("waiting: another command begins a run or cleans the store")
        door = lock(store.root / "door.lock", wait=True)
    try:
        sweep(store.tmp)
        yield
    finally:
        os.close(door)


# ── gc ───────────────────────────────────────────────────────────────────────────────────────────────────────────────


def collect(project: Project, agreed: Callable[[], bool] = lambda: True) -> int:
    """Show the results that are not current for any dataset, nor what such a one was made from; delete them if `agreed`.

    Raises InputError while a run goes on.
    """
    store = Store(project.build / "store")
    with alone(store):
        keys, trees, rest = _dead(project, store)
        sizes = {path.name: sum(f.stat().st_size for f in path.rglob("*") if f.is_file()) for path in trees}
        freed, groups = sum(sizes.values()), {}
        for path in keys:  # by stage, of each result its age and the bytes that nothing else needs
            entry = store.entry(path.stem)
            stage, output = (entry.record["stage"], entry.output) if entry else (LEFT_OVER, "")
            groups.setdefault(stage, []).append((path.stat().st_mtime, sizes.pop(output, 0)))
        for path in (path for path in trees if path.name in sizes):
            groups.setdefault(LEFT_OVER, []).append((path.stat().st_mtime, sizes[path.name]))
        for stage, results in sorted(groups.items(), key=lambda group: -sum(size for _, size in group[1])):
            oldest, newest = (_age(time.time() - pick(kept for kept, _ in results)) for pick in (min, max))
            what = f"{stage:<10} {len(results):>5} {'result ' if len(results) == 1 else 'results'}"
            age = newest if oldest == newest else f"{newest} to {oldest}"
            print(f"{what} {sum(size for _, size in results) / 1e6:>9.1f} MB   {age} old")
        if groups and not agreed():
            print("nothing was deleted")
            return 0
        for path in keys + trees + rest:
            if path.is_dir() and not path.is_symlink():  # by one rename: a part might be taken for a damaged result
                os.rename(path, aside := store.tmp / f"run-gc-{path.name}")
                shutil.rmtree(aside)
            else:
                path.unlink()
    print(f"deleted {len(keys)} results that nothing names any more, {freed / 1e6:.1f} MB")
    return 0


def _age(seconds: float) -> str:
    """
    >>> _age(30), _age(7200), _age(200000)
    ('less than an hour', '2 h', '2 days')
    """
    hours = int(max(0.0, seconds) // 3600)
    return "less than an hour" if hours == 0 else f"{hours} h" if hours < 48 else f"{hours // 24} days"


def _dead(project: Project, store: Store) -> tuple[list[Path], list[Path], list[Path]]:
    """What may go from a store: files of keys, trees of results, and everything else; drafts of killed writers too."""
    homes = [Home(path) for path in project.build.glob("*") if path.is_dir() and path.name != "store"]
    keys = _needed(store, {key for home in homes for key in home.keys().values()})
    trees = {entry.output for key in keys if (entry := store.entry(key))}
    unused = [p for p in store.keys.glob("*") if p.stem not in keys or p.suffix != ".json"]
    rest = [p for p in store.logs.glob("*") if p.stem not in keys or p.suffix != ".jsonl"]
    rest += [*store.locks.glob("*"), *store.unfinished.glob("*"), *store.cache.glob(".*")]
    return unused, [p for p in (*store.trees.glob("*"), *store.damaged_trees.glob("*")) if p.name not in trees], rest


def _needed(store: Store, current: set[str]) -> set[str]:
    """Those keys, and of every result that they were made from, however far, the keys that gave it.

    A step whose result is current is current only as long as what it was made from is there, though another run may have made
    that anew in the meantime, with other parameters.
    """
    entries = {path.stem: entry for path in store.keys.glob("*.json") if (entry := store.entry(path.stem))}
    gave: dict[tuple[str, str], set[str]] = {}
    for key, entry in entries.items():
        gave.setdefault((f"input:{_step(entry)}", entry.output), set()).add(key)
    needed, stack = set(current), [key for key in current if key in entries]
    while stack:
        inputs = [item for item in entries[stack.pop()].record.items() if item[0].startswith("input:")]
        above = set().union(*(gave.get(item, set()) for item in inputs)) - needed
        stack += above
        needed |= above
    return needed


def _step(entry: Entry) -> Step:
    return Step(entry.record["stage"], entry.record.get("photo"), entry.record.get("recipe"))


# ── verify ───────────────────────────────────────────────────────────────────────────────────────────────────────────


def verify(project: Project, dataset: str | None) -> int:
    """Read every result, of a dataset or of all, and name what is not as it was kept; 1 where anything is damaged.

    What is damaged is no longer taken for right by its size and time: the next run makes it again.
    """
    homes = made_homes(project) if dataset is None else homes_of(project, dataset, "read")
    store, users, trees, damaged = Store(project.build / "store"), {}, {}, []
    for home in homes:
        for step, key in home.keys().items():
            users.setdefault(key, []).append(f"{step} ({home.folder.name})")
    keys = sorted(users.keys() | ({path.stem for path in store.keys.glob("*.json")} if dataset is None else set()))
    for key in keys:
        entry, file = store.entry(key), store.keys / f"{key}.json"
        if entry is None:
            damaged.append((file, ["missing or not readable"], users.get(key, [])))
            continue
        names = users.get(key) or [f"{_step(entry)} (of an earlier run)"]
        trees.setdefault(entry.output, (entry, []))[1].extend(names)
        if hash_of(entry.record) != key:
            damaged.append((file, ["its record is not the one that made the key"], names))
    for output, (entry, names) in trees.items():  # every tree once, whichever keys gave it
        if faults := store.damage(entry, read_all=True):
            damaged.append((store.trees / output, faults, names))
    store.save()
    for where, faults, steps in damaged:
        print(f"{', '.join(steps) or 'a result'}: {project.shown(where)}", *faults, sep="\n    ")
    more = f"{len(damaged)} damaged; the next run that needs one makes it again"
    if keys or dataset is None:
        print(f"{len(keys)} results read: {more if damaged else 'all are as they were kept'}")
    return 1 if damaged else 0


def homes_of(project: Project, dataset: str, otherwise: str) -> list[Home]:
    """The home of a dataset, or none, which is said."""
    if (home := made_home(project, dataset)) is None:
        print(f"nothing to {otherwise}: {dataset} has no results")
    return [home] if home else []


# ── clean ────────────────────────────────────────────────────────────────────────────────────────────────────────────


def clean(project: Project, dataset: str | None) -> int:
    """Forget the results of a dataset, or of all and the store with them; say what was deleted, and what else lies there.

    What a dataset's links led to in the store goes with the next gc.
    """
    homes = made_homes(project) if dataset is None else homes_of(project, dataset, "delete")
    deleted, left, store = [], [], Store(project.build / "store")
    if homes or (dataset is None and project.build.is_dir()):
        with alone(store):
            for home in homes:
                deleted += _forget(home)
                left += sorted(home.folder.iterdir()) if home.folder.is_dir() else []
            if dataset is None and not store.root.is_symlink():
                shutil.rmtree(store.root)
                deleted.append(store.root)
        if dataset is None:
            left += [path for path in sorted(project.build.iterdir()) if not any(path in it.parents for it in left)]
    for path in deleted:
        print(f"deleted {project.shown(path)}")
    for path in left:
        print(f"left    {project.shown(path)}")
    if dataset is None and not deleted:
        print("nothing to delete")
    return 0


def _forget(home: Home) -> list[Path]:
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
    return [*ours, home.mark] if home.folder.is_dir() else [home.folder]


def _is_link_to_result(path: Path) -> bool:
    return path.is_symlink() and os.readlink(path).startswith(("../store/", "../../store/"))
