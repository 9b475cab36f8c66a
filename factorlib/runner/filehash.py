"""Content hashes of files, remembered by what `stat` says of them, so that a run with nothing to do reads nothing."""

from __future__ import annotations

import contextlib
import hashlib
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, TypeVar

import msgspec

from factorlib.wholefile import replace_file

T = TypeVar("T")
Signature = tuple[int, int, int, int]
Hash = Annotated[str, msgspec.Meta(pattern="^[0-9a-f]{32}$")]
FORMAT = 4  # of the cache; one of another format is made anew
FRESH_NS = 2_000_000_000  # a file changed this recently may change again within its clock's grain: not remembered


def signature(path: Path) -> Signature:
    """What changes when the content does: size, times of content and of inode, inode."""
    stat = os.stat(path)
    return stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns, stat.st_ino


def hash_of_file(path: Path) -> str:
    """First 128 bits of the SHA-256 of a file's content, as 32 hexadecimal digits."""
    with open(path, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()[:32]


def left_over(name: str) -> bool:
    """Whether a file or folder is what Python, editors and desktops leave: hidden, a backup, or compiled Python.

    >>> [left_over(name) for name in (".a.c.swp", "a.c~", "#a.c#", "__pycache__", "a.pyc", "a.c")]
    [True, True, True, True, True, False]
    """
    return name.startswith((".", "#")) or name.endswith(("~", ".pyc")) or name == "__pycache__"


def write_cache(path: Path, tables: Any) -> None:
    """In whole or not at all; where it cannot be written (a full disk, a read-only folder) the next run takes longer, no more."""
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        replace_file(path, msgspec.json.encode(tables))


def _known(entry: Any, now: Signature, type_: Any) -> Any:
    """What a file's entry in the cache holds; None where it is of another state of the file, or damaged."""
    try:
        then, value = msgspec.convert(entry, tuple[Signature, Any])
        return msgspec.convert(value, type_) if then == now else None
    except (msgspec.ValidationError, OverflowError):
        return None


class FileHashes:
    """A cache beside the store; `save` writes it, in whole or not at all."""

    def __init__(self, cache: Path | None):
        self.cache = cache
        self._contents, self._sources = (table if isinstance(table, dict) else {} for table in self._read())
        self._changed = False

    def content(self, path: Path) -> str:
        """`hash_of_file`, from the cache where the file's size, times and inode are unchanged."""
        return self._remembered(self._contents, path, lambda: hash_of_file(path), Hash)

    def source(self, path: Path, parse: Callable[[], T], type_: type[T]) -> T:
        """What `parse` makes of a file of source, remembered; type_: what that is."""
        return self._remembered(self._sources, path, parse, type_)

    def _remembered(self, table: dict, path: Path, make: Callable, type_: type) -> Any:
        now = signature(path)
        known = _known(table.get(str(path)), now, type_)
        if known is not None:
            return known
        value = make()
        if signature(path) == now and time.time_ns() - max(now[1], now[2]) > FRESH_NS:
            table[str(path)], self._changed = (now, value), True
        return value

    def _read(self) -> tuple[dict, dict]:
        try:
            tables = msgspec.json.decode(self.cache.read_bytes())
            return (tables["contents"], tables["sources"]) if tables["format"] == FORMAT else ({}, {})
        except (AttributeError, OSError, msgspec.DecodeError, KeyError, TypeError, RecursionError):
            return {}, {}

    def save(self) -> None:
        """Write the cache, where there is anything new to write."""
        if not self._changed or self.cache is None:
            return
        write_cache(self.cache, {"format": FORMAT, "contents": self._contents, "sources": self._sources})
        self._changed = False
