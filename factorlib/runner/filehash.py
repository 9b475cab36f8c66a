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
Hash = Annotated[str, msgspec.Meta(pattern="^[0-9a-f]{32}$")]
FORMAT = 8  # of the cache; one of another format is made anew
FRESH_NS = 2_000_000_000  # a file changed this recently may change again within its clock's grain: not remembered


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


def read_cache(path: Path | None, type_: type[T]) -> T | None:
    """What a cache holds; None where there is none, or it is damaged or of another kind."""
    try:
        return msgspec.json.decode(path.read_bytes(), type=type_) if path else None
    except (OSError, msgspec.MsgspecError, UnicodeError, RecursionError):
        return None


def write_cache(path: Path, tables: Any) -> None:
    """Replace a cache; where it cannot be written (a full disk, a read-only folder) the next run takes longer, no more."""
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        replace_file(path, msgspec.json.encode(tables))


class FileHashes:
    """What was made of files, by kind and path, in a cache beside the store; `save` writes it.  cache: its file, None to keep nothing."""

    def __init__(self, cache: Path | None):
        self.cache, self._changed = cache, False
        format_, tables = read_cache(cache, tuple[int, dict[str, dict[str, Any]]]) or (0, {})
        self._tables = tables if format_ == FORMAT else {}

    def content(self, path: Path) -> str:
        """`hash_of_file`, from the cache where the file's size, times and inode are unchanged."""
        return self.remembered("content", path, lambda: hash_of_file(path), Hash)

    def remembered(self, kind: str, path: Path, make: Callable[[], T], type_: type[T]) -> T:
        """What `make` makes of the content of a file, from the cache where that is unchanged; type_: what it is."""
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
