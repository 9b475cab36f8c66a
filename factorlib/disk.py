"""Errors of a full disk or a folder without write permission, for the user to fix: the folder and its free space."""

from __future__ import annotations

import errno
import os
import shutil
from pathlib import Path

from factorlib.errors import InputError

FULL = {
    errno.ENOSPC: "the disk is full",
    errno.EDQUOT: "the disk quota is used up",
    errno.EFBIG: "no file may become that large (ulimit -f)",
}
CLOSED = {errno.EROFS: "the folder is read-only", errno.EACCES: "permission denied", errno.EPERM: "permission denied"}
ROOM = "make room there, for instance by `make gc`, which deletes results that nothing names any more, and run again"


def disk_error(error: BaseException, folder: Path) -> InputError | None:
    """Convert an error that a full disk or a missing permission has caused; None for any other error.

    `folder` is the folder being written to, for an error that does not name one.
    """
    behind = [error]
    while (cause := behind[-1].__cause__ or behind[-1].__context__) is not None and cause not in behind:
        behind.append(cause)
    full = next((each for each in behind if _code(each) in FULL), None)
    words = FULL[_code(full)] if full else CLOSED.get(_code(error))  # type: ignore[arg-type, index]
    if words is None:
        return None
    of = full or error
    name = getattr(error, "filename", None)
    if not full and isinstance(name, str) and os.path.isfile(name) and not os.access(name, os.R_OK):
        return InputError(f"{words}: it may not be read", file=name, cure="give yourself the right to read it")
    names = (getattr(of, "filename", None), getattr(of, "filename2", None))  # A copy has two; the last is written.
    paths = [Path(os.path.abspath(os.fsdecode(name))).parent for name in names if isinstance(name, str | bytes)]
    # nearest existing folders; `Path.is_dir` raises for a folder that it may not read
    folders = [next(p for p in (path, *path.parents) if os.path.isdir(p)) for path in paths or [folder.absolute()]]
    place = folders[-1] if full else next((path for path in folders if not os.access(path, os.W_OK)), folders[0])
    free = f"{shutil.disk_usage(place).free / 1e6:.1f} MB are free"
    if full:
        return InputError(f"{words}: {free}", file=place, cure=f"{ROOM}: what is finished is kept")
    cure = "give yourself the right to write there, or work in a copy elsewhere"
    return InputError(f"{words}: nothing can be written there ({free})", file=place, cure=cure)


def _code(error: BaseException) -> int | None:
    """Return the system's error code, also from the text of errors that libraries raise."""
    if isinstance(error, OSError) and error.errno is not None:
        return error.errno
    return next((code for code in (*FULL, errno.EROFS) if os.strerror(code) in str(error)), None)
