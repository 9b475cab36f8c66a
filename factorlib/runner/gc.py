"""Taking away: results no dataset's last run needs, and a dataset's results."""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import msgspec

from factorlib.runner.home import Home, made_homes
from factorlib.runner.plan import Step
from factorlib.runner.project import Project
from factorlib.runner.store import Store
from factorlib.runner.tenancy import alone

LEFT_OVER = "left over"  # what was damaged, and files without a key
INPUT = "input:"  # of the fields of a record, those that name a result it was made from


class Gone(msgspec.Struct, frozen=True):
    """What was deleted, and what is left beside it, for the runner did not make it."""

    deleted: list[Path]
    left: list[Path]

    def lines(self, shown: Callable[[Path], str]) -> list[str]:
        """A line for each path, as `shown` writes paths."""
        said = [f"deleted {shown(path)}" for path in self.deleted] or ["nothing to delete"]
        return said + [f"left    {shown(path)}" for path in self.left]


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


class _Dead(msgspec.Struct, frozen=True):
    """What may go from a store: files of keys, trees of results, and everything else."""

    keys: list[Path]
    trees: list[Path]
    rest: list[Path]


def unneeded(project: Project) -> list[Unneeded]:
    """What `collect` would delete now, by stage, the largest first; what has no stage any more is `left over`."""
    store = Store(project.build / "store")
    dead = _dead(project, store)
    sizes = {path.name: _size(path) for path in dead.trees}
    found: dict[str, list[tuple[float, int]]] = {}
    for path in dead.keys:
        entry = store.entry(path.stem)
        stage = entry.record.get("stage", LEFT_OVER) if entry else LEFT_OVER
        found.setdefault(stage, []).append((path.stat().st_mtime, sizes.pop(entry.output, 0) if entry else 0))
    if sizes:
        kept = [(path.stat().st_mtime, sizes[path.name]) for path in dead.trees if path.name in sizes]
        found.setdefault(LEFT_OVER, []).extend(kept)
    groups = [Unneeded(s, len(r), sum(b for _, b in r), min(t for t, _ in r), max(t for t, _ in r)) for s, r in found.items()]
    return sorted(groups, key=lambda group: (-group.bytes, group.stage))


def collect(project: Project) -> Freed:
    """Delete every result that is not current for some dataset, nor what such a one was made from; refused while a run goes on."""
    store = Store(project.build / "store")
    with alone(store):
        dead = _dead(project, store)
        freed = sum(_size(path) for path in dead.trees)
        for path in dead.keys + dead.trees + dead.rest:
            _delete(path, store.tmp / f"gc-{os.getpid()}-{path.name}")
    return Freed(len(dead.keys), freed)


def _delete(path: Path, aside: Path) -> None:
    """A folder goes from its place by one rename: where this is killed, no part of it is taken for a result that is damaged."""
    if path.is_dir() and not path.is_symlink():
        os.rename(path, aside)
        shutil.rmtree(aside)
    else:
        path.unlink()


def _dead(project: Project, store: Store) -> _Dead:
    homes = [Home(path) for path in project.build.glob("*") if path.is_dir() and path.name != "store"]
    keys = _needed(store, {key for home in homes for key in home.keys().values()})
    trees = {entry.output for key in keys if (entry := store.entry(key))}
    views = {Path(link.readlink()).name for home in homes for link in home.folder.glob("*") if link.is_symlink()}
    unused = [p for p in store.keys.glob("*") if p.stem not in keys or p.suffix != ".json"]
    rest = [p for p in store.views.glob("*") if p.name not in views]  # they only link to trees
    rest += [p for p in store.logs.glob("*") if p.stem not in keys or p.suffix != ".jsonl"]
    rest += [*store.locks.glob("*"), *store.unfinished.glob("*")]
    return _Dead(unused, [p for p in store.trees.glob("*") if p.name not in trees] + list(store.damaged.glob("*")), rest)


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
        above = {other for name, output in record.items() if name.startswith(INPUT) for other in gave.get((name.removeprefix(INPUT), output), [])}
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
        return Gone([], [])
    store = Store(project.build / "store")
    with alone(store):
        parts = [_forget(project, home) for home in made_homes(project)]
        gone = Gone([path for part in parts for path in part.deleted], [path for part in parts for path in part.left])
        if not store.root.is_symlink():
            shutil.rmtree(store.root)
            gone.deleted.append(store.root)
        gone.left.extend(path for path in sorted(project.build.iterdir()) if not any(path in left.parents for left in gone.left))
    return gone


def _forget(project: Project, home: Home) -> Gone:
    """Only what the runner put there, the mark last; a link is deleted, what it leads to is not touched."""
    folders = [folder for folder in home.folder.iterdir() if folder.is_dir() and not folder.is_symlink() and folder != home.errors]
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
    return Gone([home.folder] if not left else [*ours, home.mark], left)


def _is_link_to_result(path: Path) -> bool:
    return path.is_symlink() and os.readlink(path).startswith(("../store/", "../../store/"))


def _size(path: Path) -> int:
    return sum(file.stat().st_size for file in path.rglob("*") if file.is_file())
