"""The folders that a user sees, build/<dataset>, and looking after them and the store: verify, clean, gc.

    <stage>       link to the current result of a stage, in build/store; for a stage over photos, to a view
    current.json  which key each step and each view has
    log.jsonl     what all runs did
    errors/       where a step failed by a defect, its traceback
    recipes/      links to the current pictures of each recipe
    dataset.txt   whose results these are: only a folder with this mark is one that the runner made

A view is one more result: those of all photos of a stage in one folder, by hard links.  Each run has a folder in
store/tmp and holds a lock in it while it lives; the operating system frees the lock of a run that was killed, so a
folder whose lock nobody holds is rubbish, and no command is needed to unlock anything.
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
import os
import shlex
import shutil
import time
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated

import msgspec

from factorlib.errors import InputError, did_you_mean
from factorlib.jsonfile import json_text, read_json
from factorlib.runner.plan import Step, hash_of
from factorlib.runner.project import RESERVED, SHARED, Project, check_name
from factorlib.runner.store import (
    LOCK,
    Entry,
    Stamp,
    Store,
    damage_of,
    hash_of_file,
    is_locked,
    lock,
    remove_killed_runs,
    stamps_of,
)
from factorlib.wholefile import replace_file, write_text

log = logging.getLogger("factorlib.runner")
Key = Annotated[str, msgspec.Meta(pattern="^[0-9a-f]{32}$")]  # it becomes a part of paths
LEFT_OVER = "left over"  # what was damaged, and files without a key
LONGEST = 85  # bytes of the name of a step's files, to which suffixes are added


class Home(msgspec.Struct, frozen=True):
    """One such folder, directly in build/."""

    folder: Path

    log = property(lambda self: self.folder / "log.jsonl")
    keys_file = property(lambda self: self.folder / "current.json")
    mark = property(lambda self: self.folder / "dataset.txt")
    errors = property(lambda self: self.folder / "errors")

    def keys(self, lenient: bool = False) -> dict[str, str]:
        """Step -> key of its current result, nothing where there is none; InputError where the file is damaged.

        lenient: then a warning, and nothing
        """
        try:
            return msgspec.json.decode(self.keys_file.read_bytes(), type=dict[str, Key])
        except FileNotFoundError:
            return {}
        except (OSError, msgspec.MsgspecError, UnicodeError, RecursionError) as error:
            words = f"does not say which results are current ({getattr(error, 'strerror', None) or error})"
            cure = "delete it: the next run writes it anew and finds the results that are in the store"
            fault = InputError(words, file=self.keys_file, cure=cure)
            if not lenient:
                raise fault from error
            log.warning("%s; nothing is lost, but it is not known what changed since the last run", fault)
            return {}


def home_of(project: Project, dataset: Path, by_name: bool = False) -> Home:
    """Return build/<name of the dataset's folder>; refuse it where that is a link, or has results of another folder.

    by_name: whoever's results it holds
    """
    check_name(dataset.name, "a dataset", file=dataset, key="DATASET", reserved=RESERVED)
    home = Home(project.build / dataset.name)
    if os.path.realpath(home.folder) != os.path.join(os.path.realpath(project.build), dataset.name):
        words = "is a link, where the runner keeps a dataset's results"
        raise InputError(words, file=home.folder, cure="delete the link, or move it elsewhere")
    owner = None if by_name else owner_of(project, home)
    if owner not in (None, dataset) and not (
        os.path.isdir(dataset) and (not os.path.isdir(owner) or owner.samefile(dataset))
    ):
        words = f"two datasets are called {dataset.name!r}: build/{dataset.name} holds the results of {owner}"
        cure = f"rename one of the folders, or give its results up: make clean DATASET={shlex.quote(str(owner))}"
        raise InputError(words, file=dataset, cure=cure)
    return home


def made_home(project: Project, dataset: str) -> Home | None:
    """Find the home of a dataset that has results, by its name or path; None where it has none yet.

    The dataset itself need not be there any more.
    A name is that of a home in build/; a path must be the one that the home was made for.
    Raises InputError for anything else.
    """
    there = project.find_dataset(dataset)
    home = home_of(project, there or Path(os.path.abspath(dataset)), by_name=there is None and "/" not in dataset)
    if home.mark.is_file():
        return home
    if there is None:
        known = [other.folder.name for other in made_homes(project)]
        cure = did_you_mean(dataset, known) if known else "build/ holds no results of any dataset"
        raise InputError(f"there is no dataset {dataset!r}, and no results of one", key="DATASET", cure=cure)
    return None


def made_homes(project: Project) -> list[Home]:
    """Return every home that the runner made; links are not followed."""
    entries = sorted(project.build.iterdir()) if project.build.is_dir() else []
    homes = [Home(path) for path in entries if path.is_dir() and not path.is_symlink() and path.name not in RESERVED]
    return [home for home in homes if home.mark.is_file()]


def owner_of(project: Project, home: Home) -> Path | None:
    """Return the dataset whose results these are; None where nothing says it."""
    with contextlib.suppress(OSError):
        words = home.mark.read_text(encoding="utf-8", errors="surrogateescape").removesuffix("\n")
        return project.root / words if words else None
    return None


def claim(project: Project, home: Home, dataset: Path) -> None:
    """Write down whose results these are: relative to the project where the dataset lies in it, for checkouts move."""
    home.folder.mkdir(parents=True, exist_ok=True)
    words = str(dataset.relative_to(project.root)) if dataset.is_relative_to(project.root) else str(dataset)
    if owner_of(project, home) != project.root / words:
        replace_file(home.mark, f"{words}\n".encode("utf-8", "surrogateescape"))


def label(step: Step) -> str:
    """Name a step's own files, shortly however long the photo's name is.

    >>> label(Step("masks", "kitchen")), len(label(Step("masks", "k" * 240)))
    ('masks-kitchen', 70)
    """
    name = str(step).replace("/", "-")
    return name if len(name.encode()) <= LONGEST else f"{step.stage[:20]}-{hashlib.sha256(name.encode()).hexdigest()}"


def point(link: Path, target: Path, build: Path) -> None:
    """Make `link` name the folder `target` in one atomic step; relative within `build`, so that it can be moved."""
    words = os.path.relpath(target, link.parent) if target.is_relative_to(build) else str(target)
    if link.is_symlink() and os.readlink(link) == words:
        return
    link.parent.mkdir(parents=True, exist_ok=True)
    draft = link.with_name(f".{link.name}.{os.getpid()}")
    draft.unlink(missing_ok=True)
    os.symlink(words, draft, target_is_directory=True)
    if link.is_dir() and not link.is_symlink():
        raise InputError("is a folder of its own, where the runner puts a link", file=link, cure="move it elsewhere")
    os.replace(draft, link)


def view_of(store: Store, stage: str, keys: dict[str, str], gather: str | None) -> str:
    """Put the files of all photos of a stage ({photo: key}) into one folder; return its key.

    Each `<photo>.json` goes into `gather`, too.
    The folder is a result as those of steps are.  Its files are hard links to theirs.
    """
    entries = {photo: entry for photo, key in sorted(keys.items()) if (entry := store.entry(key))}
    record = {f"input:{stage}/{photo}": entry.output for photo, entry in entries.items()}
    record |= {"stage": stage, "photo": None, "view": gather}
    if store.get(key := hash_of(record)) is not None:
        return key
    draft = store.tmp / f"view-{uuid.uuid4().hex[:8]}-{key}"
    files: dict[str, str] = {}
    right: dict[str, Stamp] = {}
    draft.mkdir(parents=True)
    try:
        for photo, entry in entries.items():
            for name in entry.files:
                if name in files:
                    words = f"two photos write the same file {name!r}"
                    raise InputError(words, key=photo, cure="put the photo's name into it")
                (draft / name).parent.mkdir(parents=True, exist_ok=True)
                try:
                    os.link(store.trees / entry.output / name, draft / name)
                except OSError:  # no hard links on this file system
                    shutil.copy2(store.trees / entry.output / name, draft / name)
            files, right = files | entry.files, right | store.known.get(entry.output, {})
        if damage := damage_of(draft, files, right):  # a result that was spoilt since it was looked at
            cure = "run again: it is made anew"
            raise InputError(f"a result was spoilt meanwhile: {damage[0]}", key=stage, cure=cure)
        if gather:
            table = {photo: read_json(draft / f"{photo}.json") for photo in entries}
            write_text(draft / gather, json_text(table))
            (draft / gather).chmod(0o444)
            files[gather] = hash_of_file(draft / gather)
        view = store.take_in(record, draft, log.warning, files)
        store.keep(key, view)
    finally:
        shutil.rmtree(draft, ignore_errors=True)
    store.forget(key)
    store.known[view.output], store.changed = stamps_of(store.trees / view.output), True
    return key


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
    """Let only one command at a time within; what dead runs left in tmp is gone."""
    store.tmp.mkdir(parents=True, exist_ok=True)
    if (door := lock(store.root / "door.lock")) is None:
        say("waiting: another command begins a run or cleans the store")
        door = lock(store.root / "door.lock", wait=True)
    try:
        remove_killed_runs(store.tmp)
        yield
    finally:
        os.close(door)


# ── gc ───────────────────────────────────────────────────────────────────────────────────────────────────────────────


def collect(project: Project, agreed: Callable[[], bool] = lambda: True) -> int:
    """Show the results that are not current for any dataset, and that no current one is made from.

    They are deleted if `agreed`.
    Raises InputError while a run goes on.
    """
    if (store := Store(project.store)).root != project.build / "store":
        cure = f"leave {SHARED} out for the store of this checkout; of that one delete files of trees and keys by age"
        raise InputError(
            "other checkouts share this store, and what they need is not known here", file=store.root, cure=cure
        )
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
    """Format an age in hours or days.

    >>> _age(30), _age(7200), _age(200000)
    ('less than an hour', '2 h', '2 days')
    """
    hours = int(max(0.0, seconds) // 3600)
    return "less than an hour" if hours == 0 else f"{hours} h" if hours < 48 else f"{hours // 24} days"


def _dead(project: Project, store: Store) -> tuple[list[Path], list[Path], list[Path]]:
    """List the store's entries that no result refers to: files of keys, trees of results, and the rest.

    Drafts of killed writers are among the rest.
    """
    homes = [Home(path) for path in project.build.glob("*") if path.is_dir() and path.name != "store"]
    keys = _needed(store, {key for home in homes for key in home.keys().values()})
    trees = {entry.output for key in keys if (entry := store.entry(key))}
    unused = [p for p in store.keys.glob("*") if p.stem not in keys or p.suffix != ".json"]
    rest = [p for p in store.logs.glob("*") if p.stem not in keys or p.suffix != ".jsonl"]
    rest += [*store.locks.glob("*"), *store.unfinished.glob("*"), *store.cache.glob(".*")]
    return unused, [p for p in (*store.trees.glob("*"), *store.damaged_trees.glob("*")) if p.name not in trees], rest


def _needed(store: Store, current: set[str]) -> set[str]:
    """Return those keys, and of every result that they were made from, however far, the keys that gave it.

    A step whose result is current is current only as long as what it was made from is there, though another run may
    have made that anew in the meantime, with other parameters.
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
    store, users, read, damaged = Store(project.store), {}, {}, 0
    for home in homes:
        for step, key in home.keys().items():
            users.setdefault(key, []).append(f"{step} ({home.folder.name})")
    keys = sorted(users.keys() | ({path.stem for path in store.keys.glob("*.json")} if dataset is None else set()))
    for key in keys:
        place, faults, steps = store.keys / f"{key}.json", ["missing, not readable, or not of this key"], users.get(key)
        if entry := store.entry(key):
            place, steps = store.trees / entry.output, steps or [f"{_step(entry)} (of an earlier run)"]
            if place not in read:  # every tree once, whichever keys gave it
                read[place] = store.damage(entry, read_all=True)
            faults = read[place]
        if faults:
            damaged += 1
            print(f"{', '.join(steps or ['a result'])}: {project.shown(place)}", *faults, sep="\n    ")
    store.save()
    more = f"{damaged} damaged; the next run that needs one makes it again"
    if keys or dataset is None:
        print(f"{len(keys)} results read: {more if damaged else 'all are as they were kept'}")
    return 1 if damaged else 0


def homes_of(project: Project, dataset: str, otherwise: str) -> list[Home]:
    """Return the home of a dataset, or none, and say so."""
    if (home := made_home(project, dataset)) is None:
        print(f"nothing to {otherwise}: {dataset} has no results")
    return [home] if home else []


# ── clean ────────────────────────────────────────────────────────────────────────────────────────────────────────────


def clean(project: Project, dataset: str | None) -> int:
    """Forget the results of a dataset, or of all and the store with them; say what is deleted, and what else is there.

    What a dataset's links led to in the store goes with the next gc.
    """
    homes = made_homes(project) if dataset is None else homes_of(project, dataset, "delete")
    deleted, left, store = [], [], Store(project.store)
    if homes or (dataset is None and project.build.is_dir()):
        with alone(store):
            for home in homes:
                deleted += _forget(home)
                left += sorted(home.folder.iterdir()) if home.folder.is_dir() else []
            if dataset is None and store.root == project.build / "store" and not store.root.is_symlink():
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
    """Delete what the runner put there, the mark last; a link is deleted, what it leads to is not touched."""
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
    return path.is_symlink() and Path(os.readlink(path)).parent.name == "trees"
