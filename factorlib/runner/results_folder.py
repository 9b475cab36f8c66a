"""The folders build/<dataset> that a user sees, and the verbs that maintain them and the store: verify, clean, gc.

    <stage>       link to the current result of a stage, in build/store; of a stage over photos, to a view
    current.json  key of each step and view
    log.jsonl     events of all runs
    errors/       traceback of each step that failed by a defect
    recipes/      links to the current pictures of each recipe
    dataset.txt   the dataset; only a folder with this file was made by the runner

A view is a result, too: the files of all photos of a stage in one folder, as hard links.  Each run has a folder in
store/tmp and holds a lock in it while it lives.  The operating system frees the lock of a killed run, so its folder can
be deleted, and there is no unlock command.
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

import msgspec

from factorlib.errors import InputError, did_you_mean
from factorlib.jsonfile import json_text, read_json
from factorlib.runner.plan import Step, hash_of
from factorlib.runner.project import RESERVED, SHARED, Project, check_name
from factorlib.runner.store import (
    DECODE_ERRORS,
    LOCK,
    Entry,
    Hash,
    Report,
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
NO_STAGE = "left over"  # damaged results, and files without a key
LONGEST = 85  # bytes of the name of a step's files, without suffixes


class ResultsFolder(msgspec.Struct, frozen=True):
    """One such folder, directly in build/."""

    folder: Path

    log = property(lambda self: self.folder / "log.jsonl")
    keys_file = property(lambda self: self.folder / "current.json")
    mark = property(lambda self: self.folder / "dataset.txt")
    errors = property(lambda self: self.folder / "errors")

    def keys(self) -> dict[str, str]:
        """Return the key of each step's current result; InputError if the file is damaged."""
        try:
            return msgspec.json.decode(self.keys_file.read_bytes(), type=dict[str, Hash])  # a key is a part of paths
        except FileNotFoundError:
            return {}
        except DECODE_ERRORS as error:
            fault = f"does not list the current results ({getattr(error, 'strerror', None) or error})"
            cure = "delete it: the next run writes it again and finds the results in the store"
            raise InputError(fault, file=self.keys_file, cure=cure) from error

    def keys_if_readable(self) -> dict[str, str]:
        """Return the keys; none, with a warning, if the file is damaged."""
        try:
            return self.keys()
        except InputError as error:
            log.warning("%s; nothing is lost, but the changes since the last run are unknown", error)
            return {}

    def owner(self, project: Project) -> Path | None:
        """Return the dataset's folder; None if no file tells."""
        with contextlib.suppress(OSError):
            path = self.mark.read_text(encoding="utf-8", errors="surrogateescape").removesuffix("\n")
            return project.root / path if path else None
        return None

    def set_owner(self, project: Project, dataset: Path) -> None:
        """Write the dataset's folder down, relative to the project if it lies inside, so that checkouts can move."""
        self.folder.mkdir(parents=True, exist_ok=True)
        path = dataset.relative_to(project.root) if dataset.is_relative_to(project.root) else dataset
        if self.owner(project) != project.root / path:
            replace_file(self.mark, f"{path}\n".encode("utf-8", "surrogateescape"))


def results_of(project: Project, dataset: Path, by_name: bool = False) -> ResultsFolder:
    """Return build/<name of the dataset's folder>, which may not exist yet.

    Raises:
        InputError: It is a link, or (unless it was asked for `by_name`) has the results of another dataset.
    """
    check_name(dataset.name, "a dataset", file=dataset, key="DATASET", reserved=RESERVED)
    results = ResultsFolder(project.build / dataset.name)
    if os.path.realpath(results.folder) != os.path.join(os.path.realpath(project.build), dataset.name):
        fault = "is a link; the runner keeps the results of a dataset in a folder"
        raise InputError(fault, file=results.folder, cure="delete the link, or move it elsewhere")
    owner = None if by_name else results.owner(project)
    moved = os.path.isdir(dataset) and owner is not None and (not os.path.isdir(owner) or owner.samefile(dataset))
    if owner not in (None, dataset) and not moved:
        fault = f"two datasets are called {dataset.name!r}: build/{dataset.name} holds the results of {owner}"
        cure = f"rename one of the folders, or give up these results: make clean DATASET={shlex.quote(str(owner))}"
        raise InputError(fault, file=dataset, cure=cure)
    return results


def all_results(project: Project) -> list[ResultsFolder]:
    """Return the results folders that the runner has made in build/."""
    folders = (ResultsFolder(path) for path in sorted(project.build.glob("*")))
    return [results for results in folders if results.mark.is_file()]


def find_results(project: Project, dataset: str | None, verb: str) -> list[ResultsFolder]:
    """Return the results folder of a dataset, or of all; a message tells that there is nothing to `verb`.

    The dataset itself may be gone: a name is that of a folder in build/, a path that for which the folder was made.

    Raises:
        InputError: There is neither a dataset nor a results folder.
    """
    if dataset is None:
        return all_results(project)
    folder = project.find_dataset(dataset)
    by_name = folder is None and "/" not in dataset
    results = results_of(project, folder or Path(os.path.abspath(dataset)), by_name)
    if results.mark.is_file():
        return [results]
    if folder is None:
        known = [other.folder.name for other in all_results(project)]
        cure = did_you_mean(dataset, known) if known else "build/ holds no results of any dataset"
        raise InputError(f"there is no dataset {dataset!r}, and no results of one", key="DATASET", cure=cure)
    print(f"nothing to {verb}: {dataset} has no results")
    return []


def label(step: Step) -> str:
    """Return a name for a step's files, short however long the photo's name is.

    >>> label(Step("masks", "kitchen")), len(label(Step("masks", "k" * 240)))
    ('masks-kitchen', 70)
    """
    name = str(step).replace("/", "-")
    return name if len(name.encode()) <= LONGEST else f"{step.stage[:20]}-{hashlib.sha256(name.encode()).hexdigest()}"


def set_link(link: Path, target: Path, build: Path) -> None:
    """Make `link` name the folder `target` in one atomic step; relative within `build`, so that it can be moved."""
    words = os.path.relpath(target, link.parent) if target.is_relative_to(build) else str(target)
    if link.is_symlink() and os.readlink(link) == words:
        return
    link.parent.mkdir(parents=True, exist_ok=True)
    draft = link.with_name(f".{link.name}.{os.getpid()}")
    draft.unlink(missing_ok=True)
    os.symlink(words, draft, target_is_directory=True)
    if link.is_dir() and not link.is_symlink():
        raise InputError("is a folder; the runner puts a link there", file=link, cure="move it elsewhere")
    os.replace(draft, link)


def view_of(store: Store, stage: str, keys: dict[str, str], gather: str | None) -> Entry:
    """Return the view of a stage over photos ({photo: key}): the files of all photos in one folder, as hard links.

    The contents of all `<photo>.json` are also written to the file `gather`.
    """
    entries = {photo: entry for photo, key in sorted(keys.items()) if (entry := store.entry(key))}
    record = {f"input:{stage}/{photo}": entry.output for photo, entry in entries.items()}
    record |= {"stage": stage, "photo": None, "view": gather}  # type: ignore[dict-item]
    key = hash_of(record)
    if store.get(key) is not None and (view := store.entry(key)):
        return view
    draft = store.tmp / f"view-{uuid.uuid4().hex[:8]}-{key}"
    files: dict[str, str] = {}
    sound: dict[str, Stamp] = {}
    draft.mkdir(parents=True)
    try:
        for photo, entry in entries.items():
            for name in entry.files:
                if name in files:
                    fault = f"two photos write the same file {name!r}"
                    raise InputError(fault, key=photo, cure="put the photo's name into the file's name")
                _link_or_copy(store.trees / entry.output / name, draft / name)
            files |= entry.files
            sound |= store.hashes.sound_tree(entry.output)
        if damage := damage_of(draft, files, sound):  # A result was damaged after the plan.
            raise InputError(f"a result was damaged: {damage[0]}", key=stage, cure="run again: it is made again")
        if gather:
            write_text(draft / gather, json_text({photo: read_json(draft / f"{photo}.json") for photo in entries}))
            (draft / gather).chmod(0o444)
            files[gather] = hash_of_file(draft / gather)
        view = store.add_tree(record, draft, log.warning, files)
        store.set_key(key, view)
    finally:
        shutil.rmtree(draft, ignore_errors=True)
    store.forget(key)
    store.hashes.set_sound_tree(view.output, stamps_of(store.trees / view.output))
    return view


def _link_or_copy(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.link(source, target)
    except OSError:  # no hard links on this file system
        shutil.copy2(source, target)


def begin_run(store: Store, report: Report) -> tuple[Path, int]:
    """Create a run's folder for unfinished results, and return it with the lock in it that shows that the run lives."""
    folder = store.tmp / f"run-{os.getpid()}-{uuid.uuid4().hex[:8]}"
    store.locks.mkdir(parents=True, exist_ok=True)
    with _entrance(store, report):
        return folder, lock(folder / LOCK)


@contextlib.contextmanager
def no_runs(store: Store) -> Iterator[None]:
    """Keep runs from starting inside, where results are deleted; InputError if a run is going on."""
    with _entrance(store, lambda _: None):
        if any(is_locked(folder / LOCK) for folder in store.tmp.iterdir()):
            raise InputError("a run is going on", file=store.root, cure="wait until it has ended")
        yield


@contextlib.contextmanager
def _entrance(store: Store, report: Report) -> Iterator[None]:
    """Admit one command at a time; the folders of killed runs are deleted first."""
    store.tmp.mkdir(parents=True, exist_ok=True)
    try:
        descriptor = lock(store.root / "door.lock")
    except BlockingIOError:
        report("waiting: another command begins a run or cleans the store")
        descriptor = lock(store.root / "door.lock", wait=True)
    try:
        remove_killed_runs(store.tmp)
        yield
    finally:
        os.close(descriptor)


# ── gc ───────────────────────────────────────────────────────────────────────────────────────────────────────────────


def collect(project: Project, confirm: Callable[[], bool] = lambda: True) -> int:
    """List the results that no dataset's current results are or need, and delete them if `confirm` returns True.

    Raises:
        InputError: A run is going on, or the store is shared.
    """
    if (store := Store(project.store)).root != project.build / "store":
        fault = "other checkouts share this store, and the results that they need are not known here"
        cure = f"leave {SHARED} out for the store of this checkout; in the shared one delete trees and keys by age"
        raise InputError(fault, file=store.root, cure=cure)
    with no_runs(store):
        keys, trees, rest = _unused(project, store)
        sizes = {path.name: sum(f.stat().st_size for f in path.rglob("*") if f.is_file()) for path in trees}
        freed = sum(sizes.values()) / 1e6
        groups: dict[str, list[tuple[float, int]]] = {}  # age in s and size of each result, by stage
        for path in keys:
            stage, output = (entry.record["stage"], entry.output) if (entry := store.entry(path.stem)) else ("", "")
            groups.setdefault(stage or NO_STAGE, []).append((_age(path), sizes.pop(output, 0)))
        for path in (path for path in trees if path.name in sizes):
            groups.setdefault(NO_STAGE, []).append((_age(path), sizes[path.name]))
        for stage, results in sorted(groups.items(), key=lambda group: -sum(size for _, size in group[1])):
            ages = dict.fromkeys(_age_text(limit(age for age, _ in results)) for limit in (min, max))
            count = f"{len(results):>5} {'result ' if len(results) == 1 else 'results'}"
            print(f"{stage:<10} {count} {sum(size for _, size in results) / 1e6:>9.1f} MB   {' to '.join(ages)} old")
        if groups and not confirm():
            print("nothing was deleted")
            return 0
        for path in keys + trees + rest:
            if path.is_dir() and not path.is_symlink():  # renamed first: a part would count as a damaged result
                aside = store.tmp / f"run-gc-{path.name}"
                os.rename(path, aside)
                shutil.rmtree(aside)
            else:
                path.unlink()
    print(f"deleted {len(keys)} results that nothing uses, {freed:.1f} MB")
    return 0


def _age(path: Path) -> float:
    return time.time() - path.stat().st_mtime


def _age_text(seconds: float) -> str:
    """Format an age in hours or days.

    >>> _age_text(30), _age_text(7200), _age_text(200000)
    ('less than an hour', '2 h', '2 days')
    """
    hours = int(max(0.0, seconds) // 3600)
    return "less than an hour" if hours == 0 else f"{hours} h" if hours < 48 else f"{hours // 24} days"


def _unused(project: Project, store: Store) -> tuple[list[Path], list[Path], list[Path]]:
    """List the store's entries that no current result refers to: keys, trees, and the rest (logs, locks, drafts)."""
    folders = [ResultsFolder(path) for path in project.build.glob("*") if path.is_dir() and path.name != "store"]
    keys = _needed(store, {key for results in folders for key in results.keys().values()})
    trees = {entry.output for key in keys if (entry := store.entry(key))}
    unused = [p for p in store.keys.glob("*") if p.stem not in keys or p.suffix != ".json"]
    rest = [p for p in store.logs.glob("*") if p.stem not in keys or p.suffix != ".jsonl"]
    rest += [path for name in ("locks/*", "unfinished/*", "cache/.*") for path in store.root.glob(name)]
    return unused, [p for name in ("trees/*", "damaged/*") for p in store.root.glob(name) if p.name not in trees], rest


def _needed(store: Store, current: set[str]) -> set[str]:
    """Return the current keys and the keys of all results that they were made from, however indirectly.

    A result is current only while its inputs are in the store, even if another run has since made these with other
    parameters.
    """
    entries = {path.stem: entry for path in store.keys.glob("*.json") if (entry := store.entry(path.stem))}
    makers: dict[tuple[str, str], set[str]] = {}
    for key, entry in entries.items():
        makers.setdefault((f"input:{_step(entry)}", entry.output), set()).add(key)
    needed = set(current)
    stack = [key for key in current if key in entries]
    while stack:
        inputs = [item for item in entries[stack.pop()].record.items() if item[0].startswith("input:")]
        above = set().union(*(makers.get(item, set()) for item in inputs)) - needed
        stack += above
        needed |= above
    return needed


def _step(entry: Entry) -> Step:
    return Step(entry.record["stage"], entry.record.get("photo"), entry.record.get("recipe"))


# ── verify ───────────────────────────────────────────────────────────────────────────────────────────────────────────


def verify(project: Project, dataset: str | None) -> int:
    """Read every stored result, of a dataset or of all, and list damaged ones; return 1 if there are any.

    The next run that needs a damaged result makes it again.
    """
    store = Store(project.store)
    users: dict[str, list[str]] = {}
    for results in find_results(project, dataset, "read"):
        for step, key in results.keys().items():
            users.setdefault(key, []).append(f"{step} ({results.folder.name})")
    keys = sorted(users.keys() | ({path.stem for path in store.keys.glob("*.json")} if dataset is None else set()))
    trees: dict[str, list[str]] = {}  # Each tree is read once, however many keys it has.
    damaged = 0
    for key in keys:
        place = store.keys / f"{key}.json"
        faults = ["missing, not readable, or not of this key"]
        if entry := store.entry(key):
            place = store.trees / entry.output
            users.setdefault(key, [f"{_step(entry)} (of an earlier run)"])
            if entry.output not in trees:
                trees[entry.output] = store.damage(entry, reread=True)
            faults = trees[entry.output]
        if faults:
            damaged += 1
            print(f"{', '.join(users.get(key, ['a result']))}: {project.shown(place)}", *faults, sep="\n    ")
    store.hashes.save()
    if keys or dataset is None:
        outcome = f"{damaged} damaged; the next run that needs one makes it again" if damaged else "all are sound"
        print(f"{len(keys)} results read: {outcome}")
    return 1 if damaged else 0


# ── clean ────────────────────────────────────────────────────────────────────────────────────────────────────────────


def clean(project: Project, dataset: str | None) -> int:
    """Delete the results folder of a dataset, or all of them and the store, and list deleted and other files.

    The results of one dataset stay in the store until the next gc.
    """
    folders = find_results(project, dataset, "delete")
    store = Store(project.store)
    deleted: list[Path] = []
    other: list[Path] = []
    if folders or (dataset is None and project.build.is_dir()):
        with no_runs(store):
            for results in folders:
                deleted += _delete(results)
                other += sorted(results.folder.iterdir()) if results.folder.is_dir() else []
            if dataset is None and store.root == project.build / "store" and not store.root.is_symlink():
                shutil.rmtree(store.root)
                deleted.append(store.root)
        if dataset is None:
            other += [path for path in sorted(project.build.iterdir()) if not any(path in it.parents for it in other)]
    for path in deleted:
        print(f"deleted {project.shown(path)}")
    for path in other:
        print(f"left    {project.shown(path)}")
    if dataset is None and not deleted:
        print("nothing to delete")
    return 0


def _delete(results: ResultsFolder) -> list[Path]:
    """Delete the runner's files of a results folder, the mark last; a link is deleted, its target is not touched."""
    paths = [path for pattern in ("*", "*/*") for path in results.folder.glob(pattern)]
    links = [path for path in paths if _is_link_to_result(path) and not path.parent.is_symlink()]
    errors = [] if results.errors.is_symlink() else sorted(results.errors.glob("*.txt"))
    files = [path for path in (results.keys_file, results.log) if path.is_symlink() or path.is_file()]
    deleted = [*links, *files, *errors, *results.folder.glob(".current.*"), results.mark]
    for path in deleted:
        path.unlink()
    for folder in (*dict.fromkeys(path.parent for path in links), results.errors, results.folder):
        with contextlib.suppress(OSError):  # not there, a link, or not empty
            folder.rmdir()
    return deleted if results.folder.is_dir() else [results.folder]


def _is_link_to_result(path: Path) -> bool:
    return path.is_symlink() and Path(os.readlink(path)).parent.name == "trees"
