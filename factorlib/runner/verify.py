"""Reading every result there is, and saying which are no longer what they were when they were kept.

What is found damaged here is no longer taken for right by its size and time: the next run makes it again.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from pathlib import Path

from factorlib.errors import InputError
from factorlib.runner.filehash import hash_of_file
from factorlib.runner.home import Home, gathered
from factorlib.runner.integrity import Inspector, stamps_of
from factorlib.runner.pipeline import Pipeline
from factorlib.runner.plan import key_of
from factorlib.runner.store import Entry, Store

Damage = tuple[Path, list[str], list[str]]  # where; a line for each fault; whose result, as `masks/kitchen (eames)`


def verify(store: Store, homes: list[Home], pipeline: Pipeline, everything: bool) -> tuple[int, list[Damage]]:
    """Read the results that `homes` name, or everything in the store; how many there are, and what is damaged."""
    inspector = Inspector(store.root)
    users = _users(homes)
    keys = sorted(users.keys() | ({path.stem for path in store.keys.glob("*.json")} if everything else set()))
    entries = {key: store.entry(key) for key in keys}
    damaged = [
        (store.keys / f"{key}.json", ["missing or not readable"], users.get(key, []))
        for key in keys
        if entries[key] is None
    ]
    good = {key: entry for key, entry in entries.items() if entry}
    damaged += [_of_record(store, key, entry, users) for key, entry in good.items() if key_of(entry.record) != key]
    damaged += list(_of_trees(store, inspector, good, users))
    damaged += [found for home in homes for found in _of_views(store, home, good, pipeline)]
    inspector.save()
    return len(keys), damaged


def _users(homes: list[Home]) -> dict[str, list[str]]:
    """By key, the steps whose current result it is."""
    users: dict[str, list[str]] = {}
    for home in homes:
        for step, key in home.keys().items():
            users.setdefault(key, []).append(f"{step} ({home.folder.name})")
    return users


def _name(key: str, entry: Entry, users: Mapping[str, list[str]]) -> list[str]:
    photo = entry.record.get("photo") or entry.record.get("recipe")
    return users.get(key) or [f"{entry.record.get('stage')}{f'/{photo}' if photo else ''} (of an earlier run)"]


def _of_record(store: Store, key: str, entry: Entry, users: Mapping[str, list[str]]) -> Damage:
    return (store.keys / f"{key}.json", ["its record is not the one that made the key"], _name(key, entry, users))


def _of_trees(
    store: Store, inspector: Inspector, entries: Mapping[str, Entry], users: Mapping[str, list[str]]
) -> Iterator[Damage]:
    """Every tree once, whichever keys gave it."""
    of_tree: dict[str, list[str]] = {}
    for key, entry in entries.items():
        of_tree.setdefault(entry.output, []).append(key)
    for output, keys in of_tree.items():
        if what := inspector.thorough(output, entries[keys[0]].files):
            steps = [name for key in keys for name in _name(key, entries[key], users)]
            yield (store.tree(output), what, steps)


def _of_views(store: Store, home: Home, entries: Mapping[str, Entry], pipeline: Pipeline) -> Iterator[Damage]:
    """The folders with the results of all photos, which the links of a dataset name."""
    by_stage: dict[str, dict[str, Entry]] = {}
    for step, key in home.keys().items():
        stage, _, photo = step.partition("/")
        if photo and key in entries:
            by_stage.setdefault(stage, {})[photo] = entries[key]
    for stage, of_photos in by_stage.items():
        link = home.folder / stage
        if link.is_dir() and link.resolve().parent == store.views.resolve():
            gather = pipeline.stages[stage].gather if stage in pipeline.stages else None
            if what := list(_of_view(store, link.resolve(), of_photos, gather)):
                yield (link, what, [f"{stage} ({home.folder.name})"])


def _of_view(store: Store, view: Path, of_photos: Mapping[str, Entry], gather: str | None) -> Iterator[str]:
    """A photo of which there is any file must be there in whole; one that failed in the last run is not."""
    found = set(stamps_of(view))
    shown = {photo: entry for photo, entry in of_photos.items() if found & entry.files.keys()}
    trees = {
        name: (store.tree(entry.output) / name, hash_)
        for entry in shown.values()
        for name, hash_ in entry.files.items()
    }
    for name, (file, hash_) in sorted(trees.items()):
        if name not in found:
            yield f"{name}: missing"
        elif not _is(view / name, file, hash_):
            yield f"{name}: other content"
    for name in sorted(found - trees.keys()):
        if name != gather:
            yield f"{name}: no file of this result"
        elif not _is_gathered(store, view / name, {photo: entry.output for photo, entry in shown.items()}):
            yield f"{name}: other content"


def _is(path: Path, file: Path, hash_: str) -> bool:
    """A hard link to the tree's file, which has been read there, or the same content."""
    try:
        return (file.exists() and os.path.samefile(path, file)) or hash_of_file(path) == hash_
    except OSError:
        return False


def _is_gathered(store: Store, path: Path, outputs: dict[str, str]) -> bool:
    try:
        return path.read_bytes() == gathered(store, outputs).encode()
    except (OSError, InputError):
        return False
