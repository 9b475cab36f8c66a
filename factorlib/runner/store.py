"""Results on disk: each tree of files by the hash of its content, each key pointing at the tree it gave.

    build/store/trees/<output>/   the files of a result, read-only
    build/store/keys/<key>.json   {"output", "record", "files"}: what the key gave
    build/store/logs/<key>.jsonl  what making it cost and said (times and machine facts are only here)
    build/store/views/<hash>/     the results of all photos of a stage in one folder
    build/store/unfinished/<key>/ what lets a step that was killed go on
    build/store/damaged/          what stood where a result was made again, for it was not as it had been kept
    build/store/locks, tmp, cache

A tree and a key appear by one rename each, the tree first; nothing half-written is ever visible.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
import shutil
import time
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import msgspec

from factorlib.errors import InputError
from factorlib.jsonfile import json_text
from factorlib.runner.integrity import Inspector, hashes_of_tree
from factorlib.wholefile import replace_file, sync, sync_tree

DRAFT = re.compile(r"\..+\.([0-9]{1,9})")  # of `factorlib.wholefile.replace_file`: a dot, the name, the process
OLD = 3600.0  # seconds: what is younger may be written by a process of another machine that shares the folder


class Entry(msgspec.Struct, frozen=True):
    """What a key gave: the hash of the tree, the record that made the key, and each file's hash."""

    output: str
    record: dict
    files: dict[str, str]


class Store:
    """The store of one build folder."""

    def __init__(self, root: Path):
        self.root = root
        (
            self.trees,
            self.keys,
            self.logs,
            self.views,
            self.locks,
            self.tmp,
            self.cache,
            self.unfinished,
            self.damaged,
        ) = (
            root / name for name in ("trees", "keys", "logs", "views", "locks", "tmp", "cache", "unfinished", "damaged")
        )

    def entry(self, key: str) -> Entry | None:
        """What is written of a key, None where it was never made; whether its tree is there and right an Inspector says."""
        try:
            entry = msgspec.json.decode((self.keys / f"{key}.json").read_bytes(), type=Entry)
        except (OSError, msgspec.DecodeError):  # a folder in its place, say
            return None
        return entry if output_of(entry.files) == entry.output else None

    def tree(self, output: str) -> Path:
        """Folder of the tree with hash `output`."""
        return self.trees / output

    def log(self, key: str) -> Path:
        """File with the log of the result of `key`."""
        return self.logs / f"{key}.jsonl"

    def take_in(self, record: dict, folder: Path) -> tuple[Entry, Path | None]:
        """Take the files of `folder` in, as what `record` gave; the folder is gone afterwards.

        Where the same tree stands already it stays if it is right, every content read; else it is set aside, and second
        comes where it is now.
        """
        files = hashes_of_tree(folder)
        entry = Entry(output_of(files), record, files)
        for name in files:
            (folder / name).chmod(0o444)
        sync_tree(folder)
        return entry, self.put(folder, self.tree(entry.output), lambda: holds(self.tree(entry.output), files))

    def keep(self, key: str, entry: Entry) -> None:
        """From now on `key` has that result."""
        self.keys.mkdir(parents=True, exist_ok=True)
        if (self.keys / f"{key}.json").is_dir():
            self._set_aside(self.keys / f"{key}.json")
        replace_file(self.keys / f"{key}.json", json_text(entry).encode())

    def put(self, folder: Path, target: Path, is_right: Callable[[], bool]) -> Path | None:
        """Make `folder` the folder `target` by one rename, unless what stands there is right; where that is now, if not."""
        target.parent.mkdir(parents=True, exist_ok=True)
        aside = None
        while True:
            try:
                os.rename(folder, target)
                sync(target.parent)
                return aside
            except OSError:
                if not os.path.lexists(target):
                    raise
            if is_right():
                shutil.rmtree(folder)
                return aside
            aside = self._set_aside(target)

    def _set_aside(self, target: Path) -> Path:
        self.damaged.mkdir(parents=True, exist_ok=True)
        aside = self.damaged / f"{target.name}-{uuid.uuid4().hex[:8]}"
        with contextlib.suppress(FileNotFoundError):  # another run was quicker
            os.rename(target, aside)
        return aside


class Outputs(Mapping):
    """Output hash by key, each looked up once; none of a key whose tree is not as it was kept.

    damaged: by key, what is wrong with its tree
    """

    def __init__(self, store: Store):
        self.store, self.inspector = store, Inspector(store.root)
        self.damaged: dict[str, list[str]] = {}
        self._known: dict[str, str] = {}
        self._entries: dict[str, Entry | None] = {}

    def get(self, key: str, default: Any = None) -> Any:
        """Tree hash of a key; `default` where there is no result, or its tree is damaged (then `damaged` says how)."""
        if key not in self._known:
            entry = self.entry(key)
            if entry is None:
                return default
            self.damaged.pop(key, None)
            if damage := self.inspector.damage(entry.output, entry.files):
                self.damaged[key] = damage
                return default
            self._known[key] = entry.output
        return self._known[key]

    def entry(self, key: str) -> Entry | None:
        """`Store.entry`, read once."""
        if self._entries.get(key) is None:  # what is not there yet may come
            self._entries[key] = self.store.entry(key)
        return self._entries[key]

    def forget(self, key: str) -> None:
        """Look `key` up again when it is asked for next."""
        self._known.pop(key, None)
        self._entries.pop(key, None)

    def still(self, keys: Iterable[str]) -> bool:
        """Whether those keys have the outputs they had, looked up again."""
        before = {key: self._known.get(key) for key in keys}
        for key in before:
            self.forget(key)
        now = {key: self.get(key) for key in before}
        return None not in now.values() and now == before

    def __getitem__(self, key: str) -> str:
        found = self.get(key)
        if found is None:
            raise KeyError(key)
        return found

    def __iter__(self) -> Iterator[str]:
        return (path.stem for path in self.store.keys.glob("*.json"))

    def __len__(self) -> int:
        return sum(1 for _ in self)


def output_of(files: dict[str, str]) -> str:
    """The hash of a tree: of its files' names and contents."""
    return hashlib.sha256(json.dumps(files, sort_keys=True).encode()).hexdigest()[:32]


def holds(tree: Path, files: dict[str, str]) -> bool:
    """Whether a folder has exactly those files, every content read."""
    try:
        return hashes_of_tree(tree) == files
    except (OSError, InputError):
        return False


def sweep_drafts(folder: Path) -> None:
    """Delete the drafts of writers that were killed: their process is no more, and they are OLD."""
    for path in folder.glob(".*"):
        found = DRAFT.fullmatch(path.name)
        with contextlib.suppress(OSError):
            if found and not is_alive(int(found[1])) and time.time() - path.lstat().st_mtime > OLD:
                path.unlink()


def is_alive(pid: int) -> bool:
    """Whether there is such a process on this machine, whoever's it is."""
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        pass
    return True
