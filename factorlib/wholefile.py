"""Files that exist whole or not at all: no writer leaves a truncated one, whatever error the disk reports.

Python raises the errors of `write` and `close`.  A library that ignores them must write to memory instead (`bytes_of`)
and return the bytes.
"""

import contextlib
import errno
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

from factorlib.errors import InputError

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
        before = stream.seek(0, os.SEEK_END)
        data = text.encode("utf-8")
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


# ── errors of a full disk or a folder without write permission, for the user to fix ───────────────────────────────────

FULL = {
    errno.ENOSPC: "the disk is full",
    errno.EDQUOT: "the disk quota is used up",
    errno.EFBIG: "no file may become that large (ulimit -f)",
}
CLOSED = {
    errno.EROFS: "the folder is read-only",
    errno.EACCES: "permission denied",
    errno.EPERM: "permission denied",
}
ROOM = "make room there, for instance by `make clean`, which deletes all results"


def disk_error(error: BaseException, folder: Path) -> InputError | None:
    """Convert an error that a full disk or a missing permission has caused; None for any other error.

    `folder` is the folder being written to, for an error that does not name one.
    """
    chain = [error]
    while (cause := chain[-1].__cause__ or chain[-1].__context__) is not None and cause not in chain:
        chain.append(cause)
    full = next((each for each in chain if _code(each) in FULL), None)
    words = FULL[_code(full)] if full else CLOSED.get(_code(error))  # type: ignore[arg-type, index]
    if words is None:
        return None
    name = getattr(error, "filename", None)
    if not full and isinstance(name, str) and os.path.isfile(name) and not os.access(name, os.R_OK):
        return InputError(f"{words}: it cannot be read", file=name, cure="give yourself the right to read it")
    # A copy has two names; the last is that of the written file.
    names = [getattr(full or error, attribute, None) for attribute in ("filename2", "filename")]
    path = Path(os.path.abspath(next((os.fsdecode(name) for name in names if isinstance(name, str | bytes)), folder)))
    # nearest existing folder; `Path.is_dir` raises for a folder that it may not read
    place = next(parent for parent in (path, *path.parents) if os.path.isdir(parent))
    free = f"{shutil.disk_usage(place).free / 1e6:.1f} MB are free"
    if full:
        return InputError(f"{words}: {free}", file=place, cure=f"{ROOM}: finished results are kept")
    cure = "give yourself the right to write there, or work in a copy elsewhere"
    return InputError(f"{words}: nothing can be written there ({free})", file=place, cure=cure)


def _code(error: BaseException) -> int | None:
    """Return the system's error code, also from the text of errors that libraries raise."""
    if isinstance(error, OSError) and error.errno is not None:
        return error.errno
    return next((code for code in (*FULL, errno.EROFS) if os.strerror(code) in str(error)), None)
