"""Files that are there whole or not at all: no writer leaves a cut one, whatever the disk says.

Python raises what `write` and `close` report; what a library does not report it must not write itself: let it write to
memory (`bytes_of`) and hand over the bytes.
"""

from __future__ import annotations

import contextlib
import errno
import os
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

NO_SYNC = {errno.EINVAL, errno.ENOTSUP, errno.EBADF}  # said by file systems that cannot sync a folder


@contextlib.contextmanager
def writing(path: str | Path) -> Iterator[Path]:
    """Guard what writes the file `path` inside: where that fails, the file is gone."""
    try:
        yield Path(path)
    except BaseException:
        Path(path).unlink(missing_ok=True)
        raise


def write_bytes(path: str | Path, data: bytes | memoryview) -> None:
    """Write a file, whole or not at all; OSError, with the file's name, where that fails."""
    with writing(path), open(path, "wb") as stream:
        stream.write(data)


def write_text(path: str | Path, text: str, encoding: str = "utf-8") -> None:
    """Write a text file, whole or not at all; OSError, with the file's name, where that fails."""
    write_bytes(path, text.encode(encoding))


def replace_file(path: str | Path, data: bytes) -> None:
    """Replace it by one rename, on disk when it returns: whoever reads `path` finds the old or the new content, after a power cut too."""
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
    """`text` at the end of the file, all of it or nothing; its folder is made."""
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
    """Every file and folder below a folder, and itself, on disk."""
    for path in (*folder.rglob("*"), folder):
        sync(path)


def sync(path: Path) -> None:
    """A file's content, or a folder's entries, on disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in NO_SYNC:
            raise
    finally:
        os.close(descriptor)


def bytes_of(write: Callable[[str], None]) -> bytes:
    """Return what `write(path)` writes, to a file in memory: for libraries that say nothing where there is no more room.

    Where the system has no files in memory, a temporary one stands in.  There, too, room can end (`ulimit -f`): then
    there is none for one byte more.
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
