"""Results on disk: each tree of files by the hash of its content, each key pointing at the tree it gave.

    build/store/trees/<output>/   the files of a result, read-only
    build/store/keys/<key>.json   {"output", "record", "files"}: what the key gave
    build/store/logs/<key>.jsonl  what making it cost and said (times and machine facts are only here)
    build/store/unfinished/<key>/ what lets a step that was killed go on
    build/store/damaged/          what stood where a result was made again, for it was not as it had been kept
    build/store/locks, tmp, cache

A tree and a key appear by one rename each, the tree first; nothing half-written is ever visible.  A tree is right if
its files are exactly those of its record, with their contents, but for what editors leave (`left_over`).  Sizes and
times that it had when it was right are remembered, so that it is read once; `verify` reads it again.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import logging
import os
import shutil
import stat
import time
import uuid
from collections.abc import Callable, Iterable, Mapping
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, TypeVar

import msgspec

from factorlib.errors import InputError
from factorlib.jsonfile import json_text
from factorlib.runner.plan import Record, hash_of, step_key
from factorlib.runner.project import Shipping
from factorlib.wholefile import replace_file, sync, sync_tree

log = logging.getLogger("factorlib.runner")
T = TypeVar("T")
Hash = Annotated[str, msgspec.Meta(pattern="^[0-9a-f]{32}$")]
FORMAT = 8  # of the cache; one of another format is made anew
FRESH_NS = 2_000_000_000  # a file changed this recently may change again within its clock's grain: not remembered


def hash_of_file(path: Path) -> str:
    """First 128 bits of the SHA-256 of a file's content, as 32 hexadecimal digits."""
    with open(path, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()[:32]


def left_over(name: str) -> bool:
    """Return whether a file or folder is what Python, editors and desktops leave: hidden, a backup, or compiled Python.

    >>> [left_over(name) for name in (".a.c.swp", "a.c~", "#a.c#", "__pycache__", "a.pyc", "a.c")]
    [True, True, True, True, True, False]
    """
    return name.startswith((".", "#")) or name.endswith(("~", ".pyc")) or name == "__pycache__"


def read_cache(path: Path | None, type_: type[T]) -> T | None:
    """Return what a cache holds; None where there is none, or it is damaged or of another kind."""
    try:
        return msgspec.json.decode(path.read_bytes(), type=type_) if path else None
    except (OSError, msgspec.MsgspecError, UnicodeError, RecursionError):
        return None


def write_cache(path: Path, tables: Any) -> None:
    """Replace a cache; where it cannot be written (a full disk, a read-only folder) the next run only takes longer."""
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        replace_file(path, msgspec.json.encode(tables))


class FileHashes:
    """Values made of the contents of files, by kind and path, in a cache beside the store; `save` writes it.

    cache: its file, None to keep nothing
    """

    def __init__(self, cache: Path | None):
        self.cache, self._changed = cache, False
        format_, tables = read_cache(cache, tuple[int, dict[str, dict[str, Any]]]) or (0, {})
        self._tables = tables if format_ == FORMAT else {}

    def content(self, path: Path) -> str:
        """`hash_of_file`, from the cache where the file's size, times and inode are unchanged."""
        return self.remembered("content", path, lambda: hash_of_file(path), Hash)

    def remembered(self, kind: str, path: Path, make: Callable[[], T], type_: type[T]) -> T:
        """Return what `make` makes of a file's content, from the cache where that is unchanged; type_: its type."""
        stat, table = os.stat(path), self._tables.setdefault(kind, {})
        now = stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns, stat.st_ino
        with contextlib.suppress(KeyError, OverflowError, msgspec.ValidationError):  # not there, or damaged
            then, value = msgspec.convert(table[str(path)], tuple[tuple[int, int, int, int], Any])
            if then == now:
                return msgspec.convert(value, type_)
        value, stat = make(), os.stat(path)
        unchanged = now == (stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns, stat.st_ino)
        if unchanged and time.time_ns() - max(now[1], now[2]) > FRESH_NS:
            table[str(path)], self._changed = (now, value), True
        return value

    def save(self) -> None:
        """Write the cache, where there is anything new to write."""
        if self._changed and self.cache is not None:
            write_cache(self.cache, (FORMAT, self._tables))
            self._changed = False


# ── the store ─────────────────────────────────────────────────────────────────────────────────────────────────────────

Say = Callable[[str], None]
Stamp = tuple[int, int]  # size in bytes, time of the content in ns
ABANDONED = 86400.0  # seconds after which what was being written outside a run is of a process that was killed
LOCK = "lock"  # in the folder of a run, which holds it
NO_FILE: Stamp = (-1, 0)  # a link, a pipe: nothing that a stage writes


class Entry(msgspec.Struct, frozen=True):
    """Result of a key: the hash of the tree, the record that made the key, and each file's hash."""

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
        """Return the file with the log of the result of a key."""
        return self.logs / f"{key}.jsonl"

    def entry(self, key: str) -> Entry | None:
        """Read the entry of a key, None where it was never made; whether its tree is there and right `get` says."""
        if key not in self._entries:  # what is not there yet may come
            try:
                entry = msgspec.json.decode((self.keys / f"{key}.json").read_bytes(), type=Entry)
            except (OSError, msgspec.DecodeError):  # a folder in its place, say
                return None
            if hash_of(entry.files) != entry.output or step_key(entry.record) != key:
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
        """Return whether those keys have the outputs they had, looked up again."""
        before = {key: self._outputs.get(key) for key in keys}
        for key in before:
            self.forget(key)
        return None not in before.values() and all(self.get(key) == output for key, output in before.items())

    @cached_property
    def known(self) -> dict[str, dict[str, Stamp]]:
        """Return by tree the stamps of its files when contents were right."""
        return read_cache(self.cache / "trees.json", dict[str, dict[str, Stamp]]) or {}

    def damage(self, entry: Entry, read_all: bool = False) -> list[str]:
        """List the faults of the tree of an entry, a line each; read_all: whatever is remembered of it."""
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
        Where the same tree stands already it stays if it is right, every content read; else it is set aside, with a
        message.
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
    """Lock a file until the descriptor is closed or the process ends; None where another process has it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        return descriptor
    except BlockingIOError:
        os.close(descriptor)
        return None


def is_locked(path: Path) -> bool:
    """Return whether any process has that lock; looking needs no right to write."""
    try:
        with open(path, "rb") as stream:
            fcntl.flock(stream, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except (FileNotFoundError, BlockingIOError) as error:
        return isinstance(error, BlockingIOError)
    return False


def remove_killed_runs(folder: Path) -> None:
    """Delete the folders of runs whose lock nobody holds, and drafts to which nobody has written for a day."""
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
    """List how a folder differs from `files` (relative path -> hash), a line each.

    Contents are read but for stamps in `right`.
    """
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


def sound_lines(path: Path) -> list[bytes]:
    """Read the lines of a log that are events, in order; damaged ones are left out, with a warning.

    Returns none where there is no log.
    """
    try:
        lines = path.read_bytes().splitlines()
    except FileNotFoundError:
        return []
    sound = []
    for line in lines:
        with contextlib.suppress(msgspec.MsgspecError, UnicodeError, RecursionError):
            event = msgspec.json.decode(line, type=dict)
            sound += [line] if isinstance(event.get("event"), str) else []
    if len(sound) < len(lines):
        words = "%s: %d damaged lines are left out; the results are not affected"
        log.warning(words, path, len(lines) - len(sound))
    return sound


# ── results that ship with the source ────────────────────────────────────────────────────────────────────────────────

MADE_FROM = "made_from.json"
CURE = "restore it from the repository, or make the result anew with FORCE=1"


def copied(tree: Path, draft: Path, files: dict[str, str]) -> bool:
    """Copy the files of a tree; whether each is what its hash says.  No name may lead out of the draft."""
    if any(PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts for name in files):
        return False
    shutil.rmtree(draft, ignore_errors=True)
    draft.mkdir(parents=True)
    for name in files:
        (draft / name).parent.mkdir(parents=True, exist_ok=True)
        with contextlib.suppress(FileNotFoundError):
            shutil.copyfile(tree / name, draft / name, follow_symlinks=False)
    return not damage_of(draft, files)


class Shipped(msgspec.Struct, frozen=True):
    """Content of made_from.json: the part of the record that the result depends on, and the hash of each file of it."""

    record: Record
    files: dict[str, str]


def made_from(record: Record, modules: list[str]) -> Record:
    """Return the part of a step's record that a result made by `modules` depends on.

    >>> made_from({"param:steps": 3, "source:stages.train": "1", "package:torch": "2.13"}, ["stages.train"])
    {'param:steps': 3, 'source:stages.train': '1'}
    """
    own = {f"source:{module}" for module in modules}
    return {name: value for name, value in record.items() if name.startswith("param:") or name in own}


def copy_shipped(roots: list[Path], shipping: Shipping | None, record: Record, out: Path) -> bool:
    """Copy the shipped result of `record` from below one of `roots` to `out`; False where none has the same record.

    Raises InputError where the files are not those that were shipped.
    """
    for file in (root / shipping.folder / MADE_FROM for root in roots if shipping):
        if not file.is_file():
            continue
        try:
            shipped = msgspec.json.decode(file.read_bytes(), type=Shipped)
        except msgspec.DecodeError as error:
            words = f"does not say what the shipped files were made from ({error})"
            raise InputError(words, file=file, cure=CURE) from None
        if shipping and shipped.record == made_from(record, shipping.made_by):
            if not copied(file.parent, out, shipped.files):
                raise InputError("beside it are not the files that were shipped with the source", file=file, cure=CURE)
            return True
    return False


def ship(result: Path, record: Record, root: Path, shipping: Shipping) -> Path:
    """Put the files of `result`, a flat folder that `record` gave, into the package; returns where they are."""
    target, hashes = root / shipping.folder, {}
    target.mkdir(parents=True, exist_ok=True)
    for path in sorted(result.iterdir()):
        replace_file(target / path.name, path.read_bytes())
        hashes[path.name] = hash_of_file(target / path.name)
    replace_file(target / MADE_FROM, json_text(Shipped(made_from(record, shipping.made_by), hashes)).encode())
    return target
