"""Files that exist whole or not at all: no writer leaves a truncated one, whatever error the disk reports.

Python raises the errors of `write` and `close`.  A library that ignores them must write to memory instead (`bytes_of`)
and return the bytes.
"""

from __future__ import annotations

import contextlib
import errno
import os
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

NO_SYNC = {errno.EINVAL, errno.ENOTSUP, errno.EBADF}  # errors of file systems that cannot sync a folder


@contextlib.contextmanager
def writing(path: str | Path) -> Iterator[Path]:
    """Delete the file `path` if the code inside, which writes it, fails."""
    try:
        yield Path(path)
    except BaseException:
        Path(path).unlink(missing_ok=True)
        raise


def write_bytes(path: str | Path, data: bytes | memoryview) -> None:
    """Write a file, whole or not at all; a failure raises OSError with the file's name."""
    with writing(path), open(path, "wb") as stream:
        stream.write(data)


def write_text(path: str | Path, text: str, encoding: str = "utf-8") -> None:
    """Write a text file, whole or not at all; a failure raises OSError with the file's name.

    Args:
        path: the file
        text: its content
        encoding: its encoding
    """
    write_bytes(path, text.encode(encoding))


def replace_file(path: str | Path, data: bytes) -> None:
    """Replace a file by one rename, and sync it to disk.

    A reader of `path` gets the old or the new content, after a power cut too.
    """
    path = Path(path)
    draft = path.with_name(f".{path.name}.{os.getpid()}")
    with writing(draft):
        with open(draft, "wb") as stream:
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(draft, path)
    sync(path.parent)


def append_text(path: Path, text: str) -> None:
    """Append text to a file, whole or not at all, and create its folder if needed."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with open(path, "ab", buffering=0) as stream:
        before, data = stream.seek(0, os.SEEK_END), text.encode("utf-8")
        try:
            while data:
                data = data[stream.write(data) :]
        except OSError:
            stream.truncate(before)
            raise


def sync_tree(folder: Path) -> None:
    """Sync a folder and everything below it to disk."""
    for path in (*folder.rglob("*"), folder):
        sync(path)


def sync(path: Path) -> None:
    """Sync a file's content, or a folder's entries, to disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in NO_SYNC:
            raise
    finally:
        os.close(descriptor)


def bytes_of(write: Callable[[str], None]) -> bytes:
    """Return the bytes that `write(path)` writes to a file in memory, for libraries that ignore a full disk.

    A temporary file stands in on systems without files in memory.  Its space can end too (`ulimit -f`); writing one
    more byte then fails.
    """
    in_memory = hasattr(os, "memfd_create")
    with open(os.memfd_create("factorlib"), "r+b") if in_memory else tempfile.TemporaryFile() as stream:
        try:
            write(f"/dev/fd/{stream.fileno()}")
        finally:
            size = os.fstat(stream.fileno()).st_size
            os.pwrite(stream.fileno(), b"\0", size)
        stream.seek(0)
        return stream.read(size)
