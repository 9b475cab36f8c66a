"""Results on disk: each tree of files is stored by the hash of its content, and each key points at its tree.

    build/store/trees/<output>/   files of a result, read-only
    build/store/keys/<key>.json   entry of a key: its output, record, files, cost and warnings
    build/store/views/<hash>/     files of all photos of a stage, as hard links to those of trees
    build/store/unfinished/<key>/ checkpoints of a step that was killed
    build/store/damaged/          damaged trees that a new result has replaced
    build/store/locks, tmp, cache

A tree and a key appear by one rename each, the tree first, so that nothing half-written is ever visible.  A tree is
sound if it has exactly the files of its entry, with their contents, beside temporary ones (`is_temporary`).  The cache
remembers the faults of a tree by sizes and times of its files, so that each is read once; `verify` reads all again.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import os
import shutil
import stat
import time
import uuid
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import msgspec

from factorlib.errors import InputError
from factorlib.jsonfile import json_text
from factorlib.reading import reading
from factorlib.runner.plan import Record, hash_of
from factorlib.runner.project import Shipping
from factorlib.wholefile import replace_file, sync, sync_tree

if TYPE_CHECKING:
    from filelock import BaseFileLock

T = TypeVar("T")
Report = Callable[[str], None]
Hash = Annotated[str, msgspec.Meta(pattern="^[0-9a-f]{32}$")]
Stamp = list[int]  # size in bytes, time of the content in ns
FORMAT = 10  # of the cache; one of another format is ignored
FRESH_NS = 2_000_000_000  # A file changed this recently may change again within its clock's grain: it is not cached.
NO_FILE: Stamp = [-1, 0]  # a link, a pipe: nothing that a stage may write
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
    """Content of the cache: by kind and path, the state of the file or tree and the value computed from it."""

    format: int = FORMAT
    values: dict[str, dict[str, tuple[Any, Any]]] = {}


class FileHashes:
    """Cache of values that are computed from files and trees; `save` writes it.

    file: file of the cache; None keeps it in memory
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
        before = _identity(path)
        value = self.recall(kind, path, before, type_)
        if value is None:
            value = compute()
            if before == _identity(path) and time.time_ns() - max(before[1:3]) > FRESH_NS:
                self.remember(kind, path, before, value)
        return value

    def recall(self, kind: str, path: Path | str, state: Any, type_: Any) -> Any:
        """Return the value cached for a file (by path) or tree (by hash); None unless it was cached in this state."""
        with contextlib.suppress(KeyError, msgspec.ValidationError):  # missing, or damaged
            before, value = self._cache.values[kind][str(path)]
            return msgspec.convert(value, type_) if before == state else None
        return None

    def remember(self, kind: str, path: Path | str, state: Any, value: Any) -> None:
        """Cache the value that was computed from a file or tree in this state, such as size and times."""
        self._cache.values.setdefault(kind, {})[str(path)] = (state, value)
        self._changed = True

    def save(self) -> None:
        """Write the cache if it changed; if that fails (full disk, read-only folder) the next run reads more."""
        if self._changed and self.file is not None:
            with contextlib.suppress(OSError):
                self.file.parent.mkdir(parents=True, exist_ok=True)
                replace_file(self.file, msgspec.json.encode(self._cache))
            self._changed = False


def _identity(path: Path) -> list[int]:
    status = os.stat(path)
    return [status.st_size, status.st_mtime_ns, status.st_ctime_ns, status.st_ino]


# ── the store ─────────────────────────────────────────────────────────────────────────────────────────────────────────


class Entry(msgspec.Struct, frozen=True):
    """Stored result of a key: its files, the record it was made from, its cost and warnings.

    Attributes:
        output: hash of the tree
        record: record of the key
        files: hash by relative path
        cost: times, memory and facts of the machine
        warnings: of the stage, each text once
    """

    output: str
    record: dict[str, Any]
    files: dict[str, str]
    cost: dict[str, Any]
    warnings: list[str]

    def events(self) -> list[dict[str, Any]]:
        """Return the lines of the result's log: its warnings, then its cost."""
        step = {name: self.record[name] for name in ("stage", "photo", "recipe") if name in self.record}
        lines = [{"event": "warning", "text": text} for text in self.warnings]
        return [step | {"key": hash_of(self.record)} | line for line in [*lines, {"event": "done", **self.cost}]]


class Store:
    """Store of one build folder.

    damaged: faults of damaged trees, by key
    """

    def __init__(self, root: Path):
        self.root = root
        self.trees = root / "trees"
        self.views = root / "views"
        self.keys = root / "keys"
        self.unfinished = root / "unfinished"
        self.locks = root / "locks"
        self.tmp = root / "tmp"
        self.hashes = FileHashes(root / "cache" / "files.json")
        self.damaged: dict[str, list[str]] = {}
        self._entries: dict[str, Entry] = {}
        self._outputs: dict[str, str | None] = {}

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
            self.damaged[key] = self.faults(entry)
            self._outputs[key] = None if self.damaged[key] else entry.output
        return self._outputs.get(key)

    def forget(self, keys: Iterable[str] | None = None) -> None:
        """Drop these keys, or all, from memory, so that they are read from disk again."""
        for key in list(self._entries if keys is None else keys):
            for table in (self._entries, self._outputs, self.damaged):
                table.pop(key, None)  # type: ignore[attr-defined]

    def faults(self, entry: Entry, reread: bool = False) -> list[str]:
        """List the faults of an entry's tree, a line each; `reread` ignores the cache."""
        tree = self.trees / entry.output
        stamps = stamps_of(tree)
        faults = None if reread else self.hashes.recall("tree", entry.output, stamps, list[str])
        if faults is None:
            faults = faults_of(tree, entry.files)
            self.hashes.remember("tree", entry.output, stamps, faults)
        return faults

    def add_tree(self, entry: Entry, folder: Path, report: Report) -> None:
        """Move a folder with the entry's files, read-only and synced to disk, into the store as its tree.

        A sound tree of the same content remains; a damaged one is set aside, with a message.
        """
        target = self.trees / entry.output
        target.parent.mkdir(parents=True, exist_ok=True)
        if os.path.lexists(target) and faults_of(target, entry.files):
            report(f"its stored result was damaged and is replaced; the damaged files: {self.set_aside(target)}")
        try:
            os.rename(folder, target)
            sync(target.parent)
        except OSError:
            if not target.is_dir():
                raise
            shutil.rmtree(folder)

    def set_aside(self, folder: Path) -> Path:
        """Move a damaged folder out of the way, if it is there, and return its place until the next gc."""
        aside = self.root / "damaged" / f"{folder.name}-{uuid.uuid4().hex[:8]}"
        aside.parent.mkdir(parents=True, exist_ok=True)
        with contextlib.suppress(FileNotFoundError):  # Another run was faster.
            os.rename(folder, aside)
        return aside

    def set_key(self, entry: Entry) -> None:
        """Make an entry the result of the key of its record."""
        self.keys.mkdir(parents=True, exist_ok=True)
        replace_file(self.keys / f"{hash_of(entry.record)}.json", json_text(entry).encode())


def lock(path: Path, wait: bool = False) -> BaseFileLock:
    """Lock a file until the returned lock is released or the process ends; TimeoutError if it is locked."""
    from filelock import FileLock  # A run with nothing to do does not load it.

    path.parent.mkdir(parents=True, exist_ok=True)
    file_lock = FileLock(path, mode=0o664, thread_local=False)
    file_lock.acquire(timeout=-1 if wait else 0)
    return file_lock


def is_locked(path: Path) -> bool:
    """Return True if any process holds the lock; False if this user may not ask.

    Nothing is created: the folder may be deleted meanwhile.
    """
    try:
        descriptor = os.open(path, os.O_RDWR)
    except OSError:
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)  # Shared: two that ask do not see each other.
    except OSError as error:
        return isinstance(error, BlockingIOError)
    finally:
        os.close(descriptor)
    return False


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
                stamps[prefix + entry.name] = [status.st_size, status.st_mtime_ns] if is_file else NO_FILE
    return stamps


def finish_tree(folder: Path) -> dict[str, str]:
    """Make the files below a folder read-only, sync them to disk, and return {relative path: content hash}, sorted.

    Raises:
        InputError: There is a link or a pipe.
    """
    stamps = sorted(stamps_of(folder).items())
    if special := next((name for name, stamp in stamps if stamp == NO_FILE), None):
        fault = f"a stage wrote {special!r}, which is a link or a device"
        raise InputError(fault, file=folder / special, cure="make the stage write a plain file")
    for name, _ in stamps:
        (folder / name).chmod(0o444)
    sync_tree(folder)
    return {name: hash_of_file(folder / name) for name, _ in stamps}


def faults_of(folder: Path, files: Mapping[str, str]) -> list[str]:
    """List how a folder differs from `files` (relative path -> hash), a line each."""
    lines = []
    stamps = stamps_of(folder)
    for name in sorted(files):
        if (stamp := stamps.pop(name, None)) in (None, NO_FILE):
            lines.append(f"{name}: {'a link, or no file' if stamp else 'missing'}")
            continue
        try:
            lines += [] if hash_of_file(folder / name) == files[name] else [f"{name}: other content"]
        except OSError as error:
            lines.append(f"{name}: cannot be read ({error.strerror})")
    return lines + [f"{name}: not a file of this result" for name in sorted(stamps)]


# ── results that ship with the source ────────────────────────────────────────────────────────────────────────────────

MADE_FROM = "made_from.json"
CURE = "restore it from the repository, or compute the result with FORCE=1"


class Shipped(msgspec.Struct, frozen=True):
    """Content of made_from.json, a copy of the entry of the result: its record, and the hash of each file."""

    record: Record
    files: dict[str, str]


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
        with reading("the record of a shipped result", file, cure=CURE):
            shipped = msgspec.json.decode(file.read_bytes(), type=Shipped)
        made_by = shipping.made_by if shipping else []
        if shipped_record(shipped.record, made_by) == shipped_record(record, made_by):
            out.mkdir()
            for name in (name for name in shipped.files if (file.parent / name).is_file()):
                shutil.copyfile(file.parent / name, out / name)
            if faults := faults_of(out, shipped.files):
                fault = f"the files beside it are not the files that were shipped: {faults[0]}"
                raise InputError(fault, file=file, cure=CURE)
            return True
    return False
