"""A full disk and a folder that may not be written are the user's to mend: errors that say which folder, and what is free."""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

from factorlib.errors import InputError

FULL = {
    errno.ENOSPC: "the disk is full",
    errno.EDQUOT: "the disk quota is used up",
    errno.EFBIG: "no file may become that large (ulimit -f)",
}
CLOSED = {errno.EROFS: "the folder is read-only", errno.EACCES: "permission denied", errno.EPERM: "permission denied"}


def disk_error(error: BaseException, folder: Path) -> InputError | None:
    """`error` as the user's, where a full disk or a missing right is behind it; None where neither is.

    folder: what was being written to, where the error itself does not say
    """
    for found in _behind(error):
        code = _code(found)
        if code in FULL:
            return _full(code, _folders(found, folder)[0])
        if code in CLOSED and found is error:
            return _closed(code, error, folder)
    return None


def _behind(error: BaseException | None) -> Iterator[BaseException]:
    """The error, and those that it was raised from or while handling."""
    seen: set[int] = set()
    while error is not None and id(error) not in seen:
        seen.add(id(error))
        yield error
        error = error.__cause__ or error.__context__


def _code(error: BaseException) -> int | None:
    """What the system said; libraries that have errors of their own repeat its words."""
    if isinstance(error, OSError) and error.errno is not None:
        return error.errno
    text = str(error)
    return next((code for code in (*FULL, errno.EROFS) if os.strerror(code) in text), None)


def _full(code: int, folder: Path) -> InputError:
    free = shutil.disk_usage(folder).free
    cure = "make room there, for instance by `make gc`, which deletes results that nothing names any more, and run again: what is finished is kept"
    return InputError(f"{FULL[code]}: {free / 1e6:.1f} MB are free", file=folder, cure=cure)


def _closed(code: int, error: BaseException, folder: Path) -> InputError:
    name = getattr(error, "filename", None)
    if isinstance(name, str) and os.path.isfile(name) and not os.access(name, os.R_OK):
        return InputError(f"{CLOSED[code]}: it may not be read", file=name, cure="give yourself the right to read it")
    folders = _folders(error, folder)
    folder = next((found for found in folders if not os.access(found, os.W_OK)), folders[0])
    free = shutil.disk_usage(folder).free
    cure = "give yourself the right to write there, or work in a copy elsewhere"
    return InputError(
        f"{CLOSED[code]}: nothing can be written there ({free / 1e6:.1f} MB are free)", file=folder, cure=cure
    )


def _folders(error: BaseException, folder: Path) -> list[Path]:
    """Those of the files that the error names (of a rename there are two), the given one where it names none; as far as they exist."""
    names = [
        name
        for name in (getattr(error, "filename", None), getattr(error, "filename2", None))
        if isinstance(name, str | bytes)
    ]
    paths = [Path(os.path.abspath(os.fsdecode(name))).parent for name in names] or [folder.absolute()]
    return [
        next(p for p in (path, *path.parents) if os.path.isdir(p)) for path in paths
    ]  # Path.is_dir raises where it may not look
