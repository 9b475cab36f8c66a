"""Results on disk: each tree of files by the hash of its content, each key pointing at the tree it gave.

    build/store/trees/<output>/   the files of a result, read-only
    build/store/keys/<key>.json   {"output", "record", "files"}: what the key gave
    build/store/logs/<key>.jsonl  what making it cost and said (times and machine facts are only here)
    build/store/unfinished/<key>/ what lets a step that was killed go on
    build/store/damaged/          what stood where a result was made again, for it was not as it had been kept
    build/store/locks, tmp, cache

A tree and a key appear by one rename each, the tree first; nothing half-written is ever visible.

A tree is right if its files are exactly those of its record, with their contents; what an editor or a desktop leaves
(`left_over`) is no part of it.  Sizes and times that a tree had when its contents were right are remembered in a cache, so
that a tree is read once.  A byte that flips under the same size and time is found only where every content is read.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
import shutil
import stat
import time
import uuid
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

import msgspec

from factorlib.errors import InputError
from factorlib.jsonfile import json_text
from factorlib.runner.filehash import hash_of_file, left_over, read_cache, write_cache
from factorlib.wholefile import replace_file, sync, sync_tree

DRAFT = re.compile(r"\..+\.([0-9]{1,9})")  # of `factorlib.wholefile.replace_file`: a dot, the name, the process
OLD = 3600.0  # seconds: what is younger may be written by a process of another machine that shares the folder
Stamp = tuple[int, int]  # size in bytes, time of the content in ns
NO_FILE: Stamp = (-1, 0)  # a link, a pipe: nothing that a stage writes


class Entry(msgspec.Struct, frozen=True):
    """What a key gave: the hash of the tree, the record that made the key, and each file's hash."""

    output: str
    record: dict
    files: dict[str, str]


class Store:
    """The store of one build folder."""

    def __init__(self, root: Path):
        self.root = root
        self.trees, self.keys, self.logs = root / "trees", root / "keys", root / "logs"
        self.unfinished, self.damaged = root / "unfinished", root / "damaged"
        self.locks, self.tmp, self.cache = root / "locks", root / "tmp", root / "cache"

    def entry(self, key: str) -> Entry | None:
        """What is written of a key, None where it was never made; whether its tree is there and right an Inspector says."""
        try:
            entry = msgspec.json.decode((self.keys / f"{key}.json").read_bytes(), type=Entry)
        except (OSError, msgspec.DecodeError):  # a folder in its place, say
            return None
        return entry if output_of(entry.files) == entry.output else None

    def tree(self, output: str) -> Path:
        """The folder of the tree with that hash."""
        return self.trees / output

    def log(self, key: str) -> Path:
        """The file with the log of the result of a key."""
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
        return entry, self.put(folder, self.tree(entry.output), lambda: not damage_of(self.tree(entry.output), files))

    def keep(self, key: str, entry: Entry) -> None:
        """From now on `key` has that result."""
        path = self.keys / f"{key}.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        replace_file(path, json_text(entry).encode())

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
            self.damaged.mkdir(parents=True, exist_ok=True)
            aside = self.damaged / f"{target.name}-{uuid.uuid4().hex[:8]}"
            with contextlib.suppress(FileNotFoundError):  # another run was quicker
                os.rename(target, aside)


def output_of(files: dict[str, str]) -> str:
    """The hash of a tree: of its files' names and contents."""
    return hashlib.sha256(json.dumps(files, sort_keys=True).encode()).hexdigest()[:32]


def stamps_of(folder: str | Path, above: str = "") -> dict[str, Stamp]:
    """{relative path: stamp} of what lies below a folder, with `above` before each path; empty where there is none."""
    stamps: dict[str, Stamp] = {}
    with contextlib.suppress(FileNotFoundError, NotADirectoryError):
        for entry in [entry for entry in os.scandir(folder) if not left_over(entry.name)]:
            if entry.is_dir(follow_symlinks=False):
                stamps |= stamps_of(entry.path, f"{above}{entry.name}/")
                continue
            with contextlib.suppress(FileNotFoundError):
                facts = entry.stat(follow_symlinks=False)
                is_file = stat.S_ISREG(facts.st_mode)
                stamps[above + entry.name] = (facts.st_size, facts.st_mtime_ns) if is_file else NO_FILE
    return stamps


def hashes_of_tree(folder: Path) -> dict[str, str]:
    """{relative path: content hash} of every file below a folder, sorted; refuses links, which would lead out of it."""
    stamps = sorted(stamps_of(folder).items())
    if other := next((name for name, stamp in stamps if stamp == NO_FILE), None):
        raise InputError(f"a stage left {other!r}, which is no file", file=folder / other, cure="write a file")
    return {name: hash_of_file(folder / name) for name, _ in stamps}


def damage_of(folder: Path, files: Mapping[str, str], right: Mapping[str, Stamp] | None = None) -> list[str]:
    """How a folder is not what `files` (relative path -> hash) says, a line each; contents are read but for stamps in `right`."""
    lines, now = [], stamps_of(folder)
    for name in sorted(files):
        if (stamp := now.get(name)) in (None, NO_FILE):
            lines.append(f"{name}: {'a link, or no file' if stamp else 'missing'}")
        elif stamp != (right or {}).get(name):
            try:
                lines += [] if hash_of_file(folder / name) == files[name] else [f"{name}: other content"]
            except OSError as error:
                lines.append(f"{name}: cannot be read ({error.strerror})")
    return lines + [f"{name}: no file of this result" for name in sorted(now.keys() - files.keys())]


class Inspector:
    """Output hash by key (`get`), and whether the trees of a store are as they were kept.

    known: by tree, the stamps of its files when contents were right
    damaged: by key, what is wrong with its tree, so that it has no output
    """

    def __init__(self, store: Store):
        self.store, self.cache, self._changed = store, store.cache / "trees.json", False
        self.known = read_cache(self.cache, dict[str, dict[str, Stamp]]) or {}
        self.damaged: dict[str, list[str]] = {}
        self._outputs: dict[str, str] = {}
        self._entries: dict[str, Entry | None] = {}
        self._wrong: dict[str, tuple[dict[str, Stamp], list[str]]] = {}

    def get(self, key: str) -> str | None:
        """Tree hash of a key; None where there is no result, or its tree is damaged (then `damaged` says how)."""
        if key not in self._outputs and (entry := self.entry(key)):
            self.damaged.pop(key, None)
            if damage := self.damage(entry.output, entry.files):
                self.damaged[key] = damage
            else:
                self._outputs[key] = entry.output
        return self._outputs.get(key)

    def entry(self, key: str) -> Entry | None:
        """`Store.entry`, read once."""
        if self._entries.get(key) is None:  # what is not there yet may come
            self._entries[key] = self.store.entry(key)
        return self._entries[key]

    def forget(self, key: str) -> None:
        """Look `key` up again when it is asked for next."""
        self._outputs.pop(key, None)
        self._entries.pop(key, None)

    def still(self, keys: Iterable[str]) -> bool:
        """Whether those keys have the outputs they had, looked up again."""
        before = {key: self._outputs.get(key) for key in keys}
        for key in before:
            self.forget(key)
        return None not in before.values() and all(self.get(key) == output for key, output in before.items())

    def damage(self, output: str, files: Mapping[str, str]) -> list[str]:
        """What is wrong with a tree that should hold `files` (relative path -> hash), a line each; empty where nothing is."""
        now = stamps_of(self.store.tree(output))
        if now and now == self.known.get(output):
            return []
        if self._wrong.get(output, (None,))[0] != now:
            self._wrong[output] = now, self.thorough(output, files, self.known.get(output, {}))
        return self._wrong[output][1]

    def thorough(self, output: str, files: Mapping[str, str], right: Mapping[str, Stamp] | None = None) -> list[str]:
        """The same, with every content read, but for files whose stamps are in `right`."""
        tree = self.store.tree(output)
        now, damage = stamps_of(tree), damage_of(tree, files, right)
        if damage:
            self._changed |= self.known.pop(output, None) is not None
        else:
            self.remember(output, now)
        return damage

    def remember(self, name: str, stamps: dict[str, Stamp]) -> None:
        """Note the stamps of a tree whose contents were right."""
        if self.known.get(name) != stamps:
            self.known[name], self._changed = stamps, True

    def save(self) -> None:
        """Write the cache, where there is anything new to write."""
        if self._changed:
            write_cache(
                self.cache, {name: stamps for name, stamps in self.known.items() if self.store.tree(name).is_dir()}
            )
            self._changed = False


def sweep_drafts(folder: Path) -> None:
    """Delete the drafts of writers that were killed: their process is no more, and they are OLD."""
    for path in folder.glob(".*"):
        named = DRAFT.fullmatch(path.name)
        with contextlib.suppress(OSError):
            if named and not is_alive(int(named[1])) and time.time() - path.lstat().st_mtime > OLD:
                path.unlink()


def is_alive(pid: int) -> bool:
    """Whether there is such a process on this machine, whoever's it is."""
    try:
        os.kill(pid, 0)
        return True
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        return True
