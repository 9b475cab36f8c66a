"""Results on disk: each tree of files is stored by the hash of its content, and each key points at its tree.

    build/store/trees/<output>/   files of a result, read-only
    build/store/keys/<key>.json   {"output", "record", "files"}: the result of a key
    build/store/logs/<key>.jsonl  cost and warnings of a result (times and machine facts are only here)
    build/store/unfinished/<key>/ checkpoints of a step that was killed
    build/store/damaged/          damaged trees that a new result has replaced
    build/store/locks, tmp, cache

A tree and a key appear by one rename each, the tree first, so that nothing half-written is ever visible.  A tree is
sound if it has exactly the files of its record, with their contents, beside temporary ones (`is_temporary`).  The cache
has sizes and times of sound trees, so that each is read once; `verify` reads all again.
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
from pathlib import Path
from typing import Annotated, Any, TypeVar

import msgspec

from factorlib.errors import InputError
from factorlib.jsonfile import json_text
from factorlib.runner.plan import Record, hash_of
from factorlib.runner.project import Shipping
from factorlib.wholefile import replace_file, sync, sync_tree

log = logging.getLogger("factorlib.runner")
T = TypeVar("T")
Hash = Annotated[str, msgspec.Meta(pattern="^[0-9a-f]{32}$")]
Stamp = tuple[int, int]  # size in bytes, time of the content in ns
FORMAT = 9  # of the cache; one of another format is ignored
FRESH_NS = 2_000_000_000  # A file changed this recently may change again within its clock's grain: it is not cached.
DECODE_ERRORS = (OSError, msgspec.MsgspecError, UnicodeError, RecursionError)


def hash_of_file(path: Path) -> str:
    """Return the first 128 bits of the SHA-256 of a file's content, as 32 hexadecimal digits."""
    with open(path, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()[:32]


def is_temporary(name: str) -> bool:
    """Return True for what Python, editors and desktops leave: hidden, a backup, or compiled Python.

    >>> [is_temporary(name) for name in (".a.c.swp", "a.c~", "#a.c#", "__pycache__", "a.pyc", "a.c")]
    [True, True, True, True, True, False]
    """
    return name.startswith((".", "#")) or name.endswith(("~", ".pyc")) or name == "__pycache__"


class _Cache(msgspec.Struct, array_like=True):
    """Content of the cache: values by kind and path with the file's stamp, and stamps of sound trees."""

    format: int = FORMAT
    values: dict[str, dict[str, Any]] = {}
    trees: dict[str, dict[str, Stamp]] = {}


class FileHashes:
    """Cache of values that are computed from files; `save` writes it.

    file: of the cache, None for none
    """

    def __init__(self, file: Path | None):
        self.file = file
        self._changed = False
        self._cache = _Cache()
        with contextlib.suppress(*DECODE_ERRORS):
            cache = msgspec.json.decode(file.read_bytes(), type=_Cache) if file else self._cache
            self._cache = cache if cache.format == FORMAT else self._cache

    def content(self, path: Path) -> str:
        """Return `hash_of_file`, from the cache if the file's size, times and inode are unchanged."""
        return self.cached("content", path, lambda: hash_of_file(path), Hash)

    def cached(self, kind: str, path: Path, compute: Callable[[], T], type_: Any) -> T:
        """Return a value of a type that `compute` derives from a file, from the cache if the file is unchanged."""
        table = self._cache.values.setdefault(kind, {})
        before = _identity(path)
        with contextlib.suppress(KeyError, OverflowError, msgspec.ValidationError):  # missing, or damaged
            stamp, value = msgspec.convert(table[str(path)], tuple[tuple[int, int, int, int], Any])
            if stamp == before:
                return msgspec.convert(value, type_)
        value = compute()
        if before == _identity(path) and time.time_ns() - max(before[1:3]) > FRESH_NS:
            table[str(path)] = (before, value)
            self._changed = True
        return value

    def sound_tree(self, output: str) -> dict[str, Stamp]:
        """Return the stamps of a tree's files when they were last found sound; empty if never."""
        return self._cache.trees.get(output, {})

    def set_sound_tree(self, output: str, stamps: dict[str, Stamp]) -> None:
        """Set the stamps of a sound tree; none for a damaged one."""
        self._changed |= self.sound_tree(output) != stamps
        self._cache.trees[output] = stamps

    def save(self) -> None:
        """Write the cache if it changed; if that fails (full disk, read-only folder) the next run reads more."""
        if self._changed and self.file is not None:
            self._cache.trees = {output: stamps for output, stamps in self._cache.trees.items() if stamps}
            with contextlib.suppress(OSError):
                self.file.parent.mkdir(parents=True, exist_ok=True)
                replace_file(self.file, msgspec.json.encode(self._cache))
            self._changed = False


def _identity(path: Path) -> tuple[int, int, int, int]:
    status = os.stat(path)
    return status.st_size, status.st_mtime_ns, status.st_ctime_ns, status.st_ino


# ── the store ─────────────────────────────────────────────────────────────────────────────────────────────────────────

Report = Callable[[str], None]
ABANDONED = 86400.0  # seconds without a change after which a draft outside a run is of a killed process
LOCK = "lock"  # in the folder of a run, which holds it
NO_FILE: Stamp = (-1, 0)  # a link, a pipe: nothing that a stage may write


class Entry(msgspec.Struct, frozen=True):
    """Result of a key: the hash of the tree, the record of the key, and each file's hash."""

    output: str
    record: dict[str, Any]
    files: dict[str, str]


class Store:
    """Store of one build folder.

    damaged: faults of damaged trees, by key
    """

    def __init__(self, root: Path):
        self.root = root
        self.trees = root / "trees"
        self.keys = root / "keys"
        self.logs = root / "logs"
        self.unfinished = root / "unfinished"
        self.locks = root / "locks"
        self.tmp = root / "tmp"
        self.damaged: dict[str, list[str]] = {}
        self._outputs: dict[str, str | None] = {}
        self._entries: dict[str, Entry] = {}

    @cached_property
    def hashes(self) -> FileHashes:
        """Cache of the store and of the files of its datasets and sources."""
        return FileHashes(self.root / "cache" / "files.json")

    def log(self, key: str) -> Path:
        """Return the file with the log of a key's result."""
        return self.logs / f"{key}.jsonl"

    def entry(self, key: str) -> Entry | None:
        """Return the entry of a key, None if there is none or it is damaged; its tree may be damaged."""
        if key not in self._entries:
            with contextlib.suppress(*DECODE_ERRORS):  # Another process may add it later.
                entry = msgspec.json.decode((self.keys / f"{key}.json").read_bytes(), type=Entry)
                if hash_of(entry.files) == entry.output and hash_of(entry.record) == key:
                    self._entries[key] = entry
        return self._entries.get(key)

    def get(self, key: str) -> str | None:
        """Return the tree hash of a key; None if there is no result, or its tree is damaged (see `damaged`)."""
        if key not in self._outputs and (entry := self.entry(key)):
            damage = self.damage(entry)
            if damage:
                self.damaged[key] = damage
            self._outputs[key] = None if damage else entry.output
        return self._outputs.get(key)

    def forget(self, key: str) -> None:
        """Read `key` from disk when it is next asked for."""
        self._outputs.pop(key, None)
        self._entries.pop(key, None)
        self.damaged.pop(key, None)

    def forget_all(self) -> None:
        """Read all keys from disk when they are next asked for."""
        self._outputs.clear()
        self._entries.clear()
        self.damaged.clear()

    def unchanged(self, keys: Iterable[str]) -> bool:
        """Return True if the keys still have their outputs, read from disk again."""
        before = {key: self._outputs.get(key) for key in keys}
        for key in before:
            self.forget(key)
        return None not in before.values() and all(self.get(key) == output for key, output in before.items())

    def damage(self, entry: Entry, reread: bool = False) -> list[str]:
        """List the faults of an entry's tree, a line each; `reread` ignores the cache."""
        tree = self.trees / entry.output
        stamps = stamps_of(tree)
        sound = {} if reread else self.hashes.sound_tree(entry.output)
        if stamps and stamps == sound:
            return []
        damage = damage_of(tree, entry.files, sound)
        self.hashes.set_sound_tree(entry.output, {} if damage else stamps)
        return damage

    def add_tree(self, record: Record, folder: Path, report: Report, files: dict[str, str] | None = None) -> Entry:
        """Move a folder into the store as the tree of `record`.

        A sound tree of the same content remains; a damaged one is set aside, with a message.

        Args:
            record: record of the result
            folder: the folder, which no longer exists afterwards
            report: receives the message
            files: hashes of the files, if these are known and the files are read-only and on disk
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
            aside = self.root / "damaged" / f"{target.name}-{uuid.uuid4().hex[:8]}"
            aside.parent.mkdir(parents=True, exist_ok=True)
            with contextlib.suppress(FileNotFoundError):  # Another run was faster.
                os.rename(target, aside)
                report(f"its stored result was damaged and is replaced; the damaged files: {aside}")

    def set_key(self, key: str, entry: Entry) -> None:
        """Make an entry the result of `key`."""
        self.keys.mkdir(parents=True, exist_ok=True)
        replace_file(self.keys / f"{key}.json", json_text(entry).encode())


def lock(path: Path, wait: bool = False) -> int:
    """Lock a file until the returned descriptor is closed or the process ends; BlockingIOError if it is locked."""
    path.parent.mkdir(parents=True, exist_ok=True)
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except BlockingIOError:
        os.close(descriptor)
        raise
    return descriptor


def is_locked(path: Path) -> bool:
    """Return True if any process holds the lock; this needs no right to write."""
    try:
        with open(path, "rb") as stream:
            fcntl.flock(stream, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except (FileNotFoundError, BlockingIOError) as error:
        return isinstance(error, BlockingIOError)
    return False


def remove_killed_runs(folder: Path) -> None:
    """Delete the folders of runs whose lock is free, and drafts without a change for a day."""
    for path in (path for path in folder.iterdir() if path.is_dir() and not is_locked(path / LOCK)):
        with contextlib.suppress(FileNotFoundError):
            if path.name.startswith("run-") or time.time() - path.stat().st_mtime > ABANDONED:
                shutil.rmtree(path, ignore_errors=True)


def stamps_of(folder: str | Path, prefix: str = "") -> dict[str, Stamp]:
    """Return {relative path: stamp} of the files below a folder, paths beginning with `prefix`; empty if it is gone."""
    stamps: dict[str, Stamp] = {}
    with contextlib.suppress(FileNotFoundError, NotADirectoryError):
        for entry in [entry for entry in os.scandir(folder) if not is_temporary(entry.name)]:
            if entry.is_dir(follow_symlinks=False):
                stamps |= stamps_of(entry.path, f"{prefix}{entry.name}/")
                continue
            with contextlib.suppress(FileNotFoundError):
                status = entry.stat(follow_symlinks=False)
                is_file = stat.S_ISREG(status.st_mode)
                stamps[prefix + entry.name] = (status.st_size, status.st_mtime_ns) if is_file else NO_FILE
    return stamps


def hashes_of_tree(folder: Path) -> dict[str, str]:
    """Return {relative path: content hash} of the files below a folder, sorted; InputError for a link or pipe."""
    stamps = sorted(stamps_of(folder).items())
    if other := next((name for name, stamp in stamps if stamp == NO_FILE), None):
        fault = f"a stage wrote {other!r}, which is a link or a device"
        raise InputError(fault, file=folder / other, cure="write a file")
    return {name: hash_of_file(folder / name) for name, _ in stamps}


def damage_of(folder: Path, files: Mapping[str, str], sound: Mapping[str, Stamp] | None = None) -> list[str]:
    """List how a folder differs from `files` (relative path -> hash), a line each.

    A file with its stamp in `sound` is not read.
    """
    lines = []
    stamps = stamps_of(folder)
    for name in sorted(files):
        if (stamp := stamps.get(name)) in (None, NO_FILE):
            lines.append(f"{name}: {'a link, or no file' if stamp else 'missing'}")
        elif stamp != (sound or {}).get(name):
            try:
                lines += [] if hash_of_file(folder / name) == files[name] else [f"{name}: other content"]
            except OSError as error:
                lines.append(f"{name}: cannot be read ({error.strerror})")
    return lines + [f"{name}: not a file of this result" for name in sorted(stamps.keys() - files.keys())]


def read_events(path: Path) -> list[dict[str, Any]]:
    """Read the events of a log in order; none if there is no log.  A warning tells the number of damaged lines."""
    lines = path.read_bytes().splitlines() if path.is_file() else []
    events = []
    for line in lines:
        with contextlib.suppress(*DECODE_ERRORS):
            event = msgspec.json.decode(line, type=dict[str, Any])
            events += [event] if isinstance(event.get("event"), str) else []
    if len(events) < len(lines):
        count = len(lines) - len(events)
        log.warning("%s: %d damaged lines are ignored; the results are not affected", path, count)
    return events


# ── results that ship with the source ────────────────────────────────────────────────────────────────────────────────

MADE_FROM = "made_from.json"
CURE = "restore it from the repository, or compute the result with FORCE=1"
FileName = Annotated[str, msgspec.Meta(pattern=r"^\w[^/]*$")]


class Shipped(msgspec.Struct, frozen=True):
    """Content of made_from.json: the part of the record that the result depends on, and the hash of each file."""

    record: Record
    files: dict[FileName, str]


def shipped_record(record: Record, modules: list[str]) -> Record:
    """Return the part of a step's record that a result made by `modules` depends on.

    >>> shipped_record({"param:steps": 3, "source:stages.train": "1", "package:torch": "2.13"}, ["stages.train"])
    {'param:steps': 3, 'source:stages.train': '1'}
    """
    sources = {f"source:{module}" for module in modules}
    return {name: value for name, value in record.items() if name.startswith("param:") or name in sources}


def copy_shipped(roots: list[Path], shipping: Shipping | None, record: Record, out: Path) -> bool:
    """Copy the shipped result of `record` from below one of `roots` to `out`; return False if there is none.

    Raises:
        InputError: The files are not those that were shipped.
    """
    for file in (root / shipping.folder / MADE_FROM for root in roots if shipping):
        if not file.is_file():
            continue
        try:
            shipped = msgspec.json.decode(file.read_bytes(), type=Shipped)
        except msgspec.DecodeError as error:
            fault = f"does not tell what the shipped files were made from ({error})"
            raise InputError(fault, file=file, cure=CURE) from None
        if shipping and shipped.record == shipped_record(record, shipping.made_by):
            out.mkdir(parents=True)
            for name in shipped.files:
                with contextlib.suppress(FileNotFoundError):
                    shutil.copyfile(file.parent / name, out / name)
            if damage := damage_of(out, shipped.files):
                fault = f"the files beside it are not the files that were shipped: {damage[0]}"
                raise InputError(fault, file=file, cure=CURE)
            return True
    return False


def ship(store: Store, entry: Entry, folder: Path, made_by: list[str]) -> None:
    """Copy the files of a result, which has no folders, into a folder of the package."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in entry.files:
        replace_file(folder / name, (store.trees / entry.output / name).read_bytes())
    shipped = Shipped(shipped_record(entry.record, made_by), entry.files)
    replace_file(folder / MADE_FROM, json_text(shipped).encode())
