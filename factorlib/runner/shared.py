"""A store that several checkouts share: what one has made, the others copy.

`FACTORLIB_STORE=<folder>` names it.  It is laid out as every store is, but nothing there is used in place: a result is copied
into the checkout's own store, its key compared with its record and every file with its hash, and what a checkout makes is copied
there where it may write.  So a shared store that vanishes, is damaged or read-only costs time and no result, and no
command deletes anything in it: `gc` and `clean` know the checkout's own store alone.
"""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
import time
import uuid
from collections.abc import Callable
from pathlib import Path, PurePosixPath

from factorlib.errors import InputError
from factorlib.runner.integrity import hashes_of_tree
from factorlib.runner.logs import sound_lines
from factorlib.runner.plan import Record, key_of
from factorlib.runner.store import Entry, Store
from factorlib.wholefile import replace_file

VARIABLE = "FACTORLIB_STORE"
NOT_OURS = (errno.EACCES, errno.EPERM, errno.EROFS)  # to read is enough
ABANDONED = 86400.0  # seconds after which a draft in the shared store is taken to be of a run that was killed

Say = Callable[[str], None]


def shared_store(own: Path) -> Path | None:
    """The folder that FACTORLIB_STORE names, None where it names none or `own`; InputError where there is no such folder."""
    named = os.environ.get(VARIABLE)
    if not named:
        return None
    folder = Path(named).expanduser()
    try:
        if not folder.is_dir():
            raise InputError("there is no such folder", file=named, key=VARIABLE, cure="make it, or name another; it may be empty")
        return None if own.is_dir() and folder.samefile(own) else folder.resolve()
    except (OSError, RuntimeError, ValueError) as error:  # no right to look, links in a circle, a NUL
        if isinstance(error, InputError):
            raise
        raise InputError(f"cannot be looked at ({error})", file=named[:100], key=VARIABLE, cure="name a folder that you may read") from error


def has(shared: Store, key: str) -> bool:
    """Whether a result of `key` is there, by its name alone."""
    return (shared.keys / f"{key}.json").is_file()


def fetch(shared: Store, own: Store, key: str, record: Record, draft: Path, say: Say) -> tuple[Entry, Path | None] | None:
    """Copy the result of `key`, with its log, into the own store; None where the shared one has it not, or not as it was kept.

    draft: a folder of the own store that is not there yet;  second comes what `Store.take_in` gives
    """
    try:
        entry = shared.entry(key)
        if entry is None:
            return None
        if key_of(entry.record) == key and _copied(shared.tree(entry.output), draft, entry.files):
            taken = own.take_in(record, draft)
            _copy_log(shared, own, key)
            return taken
        say("the shared store's result is not as it was kept: the step is run")
    except OSError as error:
        say(f"the shared store cannot be read ({error.strerror}): the step is run")
    shutil.rmtree(draft, ignore_errors=True)
    return None


def offer(own: Store, shared: Store, key: str, entry: Entry, say: Say) -> None:
    """Copy a result into the shared store, with its log, unless it is there; silent where one may only read."""
    draft = shared.tmp / f"offer-{os.getpid()}-{uuid.uuid4().hex[:8]}"
    try:
        if not shared.root.is_dir():
            raise FileNotFoundError(errno.ENOENT, "it is gone")
        there = shared.entry(key)
        if there and _is_right(shared, there):
            return
        _drop_abandoned(shared)
        if _copied(own.tree(entry.output), draft, entry.files):
            shared.take_in(entry.record, draft)
            _copy_log(own, shared, key)
            shared.keep(key, entry)
    except OSError as error:
        if error.errno not in NOT_OURS:
            say(f"the shared store took nothing ({error.strerror}); the result is kept in build/store")
    finally:
        shutil.rmtree(draft, ignore_errors=True)


def _copied(tree: Path, draft: Path, files: dict[str, str]) -> bool:
    """Copy the files of a tree; whether each is what its hash says.  No name may lead out of the draft."""
    if any(PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts for name in files):
        return False
    shutil.rmtree(draft, ignore_errors=True)
    draft.mkdir(parents=True)
    for name in files:
        (draft / name).parent.mkdir(parents=True, exist_ok=True)
        with contextlib.suppress(FileNotFoundError):
            shutil.copyfile(tree / name, draft / name, follow_symlinks=False)
    return _holds(draft, files)


def _is_right(store: Store, entry: Entry) -> bool:
    return _holds(store.tree(entry.output), entry.files)


def _holds(folder: Path, files: dict[str, str]) -> bool:
    try:
        return hashes_of_tree(folder) == files
    except (InputError, OSError):
        return False


def _copy_log(source: Store, target: Store, key: str) -> None:
    """What the result cost and warned of when it was made, wherever that was."""
    if lines := sound_lines(source.log(key)):
        target.logs.mkdir(parents=True, exist_ok=True)
        replace_file(target.log(key), b"".join(line + b"\n" for line in lines))


def _drop_abandoned(shared: Store) -> None:
    for path in shared.tmp.glob("offer-*"):
        with contextlib.suppress(OSError):
            if time.time() - path.stat().st_mtime > ABANDONED:
                shutil.rmtree(path, ignore_errors=True)
