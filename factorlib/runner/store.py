"""Results on disk: each tree of files by the hash of its content, each key pointing at the tree it gave.

    build/store/trees/<output>/   the files of a result, read-only
    build/store/keys/<key>.json   {"output", "record", "files"}: what the key gave
    build/store/logs/<key>.jsonl  what making it cost and said (times and machine facts are only here)
    build/store/unfinished/<key>/ what lets a step that was killed go on
    build/store/damaged/          what stood where a result was made again, for it was not as it had been kept
    build/store/locks, tmp, cache

A tree and a key appear by one rename each, the tree first; nothing half-written is ever visible.  A tree is right if its
files are exactly those of its record, with their contents, but for what editors leave (`left_over`).  Sizes and times that
it had when it was right are remembered, so that it is read once; `verify` reads it again.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
import stat
import time
import uuid
from collections.abc import Callable, Iterable, Mapping
from functools import cached_property
from pathlib import Path

import msgspec

from factorlib.errors import InputError
from factorlib.jsonfile import json_text
from factorlib.runner.filehash import hash_of_file, left_over, read_cache, write_cache
from factorlib.runner.plan import hash_of
from factorlib.wholefile import replace_file, sync, sync_tree

Say = Callable[[str], None]
Stamp = tuple[int, int]  # size in bytes, time of the content in ns
ABANDONED = 86400.0  # seconds after which what was being written outside a run is of a process that was killed
LOCK = "lock"  # in the folder of a run, which holds it
NO_FILE: Stamp = (-1, 0)  # a link, a pipe: nothing that a stage writes


class Entry(msgspec.Struct, frozen=True):
    """What a key gave: the hash of the tree, the record that made the key, and each file's hash."""

    output: str
    record: dict
    files: dict[str, str]


class Store:
    """The store of one build folder.

    damaged: by key, what is wrong with its tree, so that it has no output
    """

    def __init__(self, root: Path):
        self.root = root
        self.trees, self.keys, self.logs = root / "trees", root / "keys", root / "logs"
        self.unfinished, self.damaged_trees = root / "unfinished", root / "damaged"
        self.locks, self.tmp, self.cache = root / "locks", root / "tmp", root / "cache"
        self.damaged: dict[str, list[str]] = {}
        self._outputs: dict[str, str | None] = {}
        self._entries: dict[str, Entry] = {}
        self.changed = False

    def log(self, key: str) -> Path:
        """The file with the log of the result of a key."""
        return self.logs / f"{key}.jsonl"

    def entry(self, key: str) -> Entry | None:
        """What is written of a key, None where it was never made; whether its tree is there and right `get` says."""
        if key not in self._entries:  # what is not there yet may come
            try:
                entry = msgspec.json.decode((self.keys / f"{key}.json").read_bytes(), type=Entry)
            except (OSError, msgspec.DecodeError):  # a folder in its place, say
                return None
            if hash_of(entry.files) != entry.output:
                return None
            self._entries[key] = entry
        return self._entries[key]

    def get(self, key: str) -> str | None:
        """Tree hash of a key; None where there is no result, or its tree is damaged (then `damaged` says how)."""
        if key not in self._outputs and (entry := self.entry(key)):
            if damage := self.damage(entry):
                self.damaged[key] = damage
            self._outputs[key] = None if damage else entry.output
        return self._outputs.get(key)

    def forget(self, key: str) -> None:
        """Look `key` up again when it is asked for next."""
        for known in (self._outputs, self._entries, self.damaged):
            known.pop(key, None)

    def still(self, keys: Iterable[str]) -> bool:
        """Whether those keys have the outputs they had, looked up again."""
        before = {key: self._outputs.get(key) for key in keys}
        for key in before:
            self.forget(key)
        return None not in before.values() and all(self.get(key) == output for key, output in before.items())

    @cached_property
    def known(self) -> dict[str, dict[str, Stamp]]:
        """Return by tree the stamps of its files when contents were right."""
        return read_cache(self.cache / "trees.json", dict[str, dict[str, Stamp]]) or {}

    def damage(self, entry: Entry, read_all: bool = False) -> list[str]:
        """What is wrong with the tree of an entry, a line each; read_all: whatever is remembered of it."""
        now, known = stamps_of(self.trees / entry.output), self.known.get(entry.output, {})
        if now and now == known and not read_all:
            return []
        damage = damage_of(self.trees / entry.output, entry.files, {} if read_all else known)
        if damage:
            self.changed |= self.known.pop(entry.output, None) is not None
        else:
            self.known[entry.output], self.changed = now, True
        return damage

    def save(self) -> None:
        """Write down which trees are known to be right, where there is anything new to write."""
        if self.changed:
            there = {output: stamps for output, stamps in self.known.items() if (self.trees / output).is_dir()}
            write_cache(self.cache / "trees.json", there)
            self.changed = False

    def take_in(self, record: dict, folder: Path, say: Say, files: dict[str, str] | None = None) -> Entry:
        """Take the files of `folder` in, as what `record` gave; the folder is gone afterwards.

        files: their hashes, where these are known and the files are read-only and on disk
        Where the same tree stands already it stays if it is right, every content read; else it is set aside, which is said.
        """
        if files is None:
            files = hashes_of_tree(folder)
            for name in files:
                (folder / name).chmod(0o444)
            sync_tree(folder)
        entry = Entry(hash_of(files), record, files)
        target = self.trees / entry.output
        target.parent.mkdir(parents=True, exist_ok=True)
        while True:
            try:
                os.rename(folder, target)
                sync(target.parent)
                return entry
            except OSError:
                if not os.path.lexists(target):
                    raise
            if not damage_of(target, files):
                shutil.rmtree(folder)
                return entry
            self.damaged_trees.mkdir(parents=True, exist_ok=True)
            aside = self.damaged_trees / f"{target.name}-{uuid.uuid4().hex[:8]}"
            with contextlib.suppress(FileNotFoundError):  # another run was quicker
                os.rename(target, aside)
                say(f"its kept result was damaged and is replaced; what was there: {aside}")

    def keep(self, key: str, entry: Entry) -> None:
        """Make that the result of `key` from now on."""
        self.keys.mkdir(parents=True, exist_ok=True)
        replace_file(self.keys / f"{key}.json", json_text(entry).encode())


def lock(path: Path, wait: bool = False) -> int | None:
    """A lock on a file, held until the descriptor is closed or the process ends; None where another process has it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        return descriptor
    except BlockingIOError:
        os.close(descriptor)
        return None


def is_locked(path: Path) -> bool:
    """Whether any process has that lock; looking needs no right to write."""
    try:
        with open(path, "rb") as stream:
            fcntl.flock(stream, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except (FileNotFoundError, BlockingIOError) as error:
        return isinstance(error, BlockingIOError)
    return False


def sweep(folder: Path) -> None:
    """Delete what runs left in `folder` that are dead, and drafts to which nobody has written for a day."""
    for path in (path for path in folder.iterdir() if path.is_dir() and not is_locked(path / LOCK)):
        with contextlib.suppress(FileNotFoundError):
            if path.name.startswith("run-") or time.time() - path.stat().st_mtime > ABANDONED:
                shutil.rmtree(path, ignore_errors=True)


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
