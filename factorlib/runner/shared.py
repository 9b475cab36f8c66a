"""Results that others have made: in a store that several checkouts share, and those that ship with the source.

`FACTORLIB_STORE=<folder>` names the former.  Nothing there is used in place: a result is copied into the checkout's own
store, its key compared with its record and every file with its hash, and what a checkout makes is copied there where it may
write.  So a shared store that vanishes, is damaged or read-only costs time and no result.

A shipped result lies where the package is.  A step takes it where its parameters, and the sources of the modules that make
it, are those that it was made from; FORCE=1 makes it anew.
"""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
import uuid
from pathlib import Path, PurePosixPath

import msgspec

from factorlib.errors import InputError
from factorlib.jsonfile import json_text
from factorlib.runner.filehash import hash_of_file
from factorlib.runner.home import sound_lines
from factorlib.runner.pipeline import Shipping
from factorlib.runner.plan import Record, hash_of
from factorlib.runner.store import Entry, Say, Store, damage_of, sweep
from factorlib.wholefile import replace_file

VARIABLE = "FACTORLIB_STORE"
NOT_OURS = (errno.EACCES, errno.EPERM, errno.EROFS)  # to read is enough
MADE_FROM = "made_from.json"
CURE = "restore it from the repository, or make the result anew with FORCE=1"


def shared_store(own: Path) -> Path | None:
    """The folder that FACTORLIB_STORE names, None where it names none or `own`; InputError where there is no such folder."""
    if not (named := os.environ.get(VARIABLE)):
        return None
    folder = Path(named).expanduser()
    if not os.path.isdir(folder):
        cure = "make it, or name another that you may read; it may be empty"
        raise InputError("there is no such folder", file=named[:100], key=VARIABLE, cure=cure)
    return None if own.is_dir() and folder.samefile(own) else folder.resolve()


def fetch(shared: Store, own: Store, key: str, draft: Path, say: Say) -> Entry | None:
    """Copy the result of `key`, with its log, into the own store; None where the shared one has it not, or not as it was kept.

    draft: a folder of the own store that is not there yet
    """
    try:
        if shared.entry(key) is None:
            return None
        if entry := _copied_result(shared, own, key, draft, say):
            return entry
        say("the shared store's result is not as it was kept: the step is run")
    except OSError as error:
        say(f"the shared store cannot be read ({error.strerror}): the step is run")
    shutil.rmtree(draft, ignore_errors=True)
    return None


def offer(own: Store, shared: Store, key: str, say: Say) -> None:
    """Copy a result into the shared store, with its log, unless it is there; silent where one may only read."""
    draft = shared.tmp / f"offer-{os.getpid()}-{uuid.uuid4().hex[:8]}"
    try:
        if not shared.root.is_dir():
            raise FileNotFoundError(errno.ENOENT, "it is gone")
        if (there := shared.entry(key)) and not damage_of(shared.trees / there.output, there.files):
            return
        shared.tmp.mkdir(parents=True, exist_ok=True)
        sweep(shared.tmp)
        if entry := _copied_result(own, shared, key, draft, lambda _: None):
            shared.keep(key, entry)
    except OSError as error:
        if error.errno not in NOT_OURS:
            say(f"the shared store took nothing ({error.strerror}); the result is kept in build/store")
    finally:
        shutil.rmtree(draft, ignore_errors=True)


def _copied_result(source: Store, target: Store, key: str, draft: Path, say: Say) -> Entry | None:
    """Copy tree and log of a key that is in `source`; None where any of it is not as it was kept."""
    entry, log = source.entry(key), sound_lines(source.log(key))
    if hash_of(entry.record) != key or not log or not copied(source.trees / entry.output, draft, entry.files):
        return None
    entry = target.take_in(entry.record, draft, say)
    target.logs.mkdir(parents=True, exist_ok=True)
    replace_file(target.log(key), b"".join(line + b"\n" for line in log))
    return entry


def copied(tree: Path, draft: Path, files: dict[str, str]) -> bool:
    """Copy the files of a tree; whether each is what its hash says.  No name may lead out of the draft."""
    if any(PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts for name in files):
        return False
    shutil.rmtree(draft, ignore_errors=True)
    draft.mkdir(parents=True)
    for name in files:
        (draft / name).parent.mkdir(parents=True, exist_ok=True)
        with contextlib.suppress(FileNotFoundError):
            shutil.copyfile(tree / name, draft / name, follow_symlinks=False)
    return not damage_of(draft, files)


class Shipped(msgspec.Struct, frozen=True):
    """What made_from.json says: the part of the record that the result depends on, and the hash of each file of it."""

    record: Record
    files: dict[str, str]


def made_from(record: Record, modules: list[str]) -> Record:
    """The part of a step's record that a result made by `modules` depends on.

    >>> made_from({"param:steps": 3, "source:stages.train": "1", "package:torch": "2.13"}, ["stages.train"])
    {'param:steps': 3, 'source:stages.train': '1'}
    """
    own = {f"source:{module}" for module in modules}
    return {name: value for name, value in record.items() if name.startswith("param:") or name in own}


def copy_shipped(roots: list[Path], shipping: Shipping | None, record: Record, out: Path) -> bool:
    """Copy the shipped result of `record`, from below one of `roots`, to `out`; False where none was made from the same.

    Raises InputError where the files are not those that were shipped.
    """
    for file in (root / shipping.folder / MADE_FROM for root in roots if shipping):
        if not file.is_file():
            continue
        try:
            shipped = msgspec.json.decode(file.read_bytes(), type=Shipped)
        except msgspec.DecodeError as error:
            words = f"does not say what the shipped files were made from ({error})"
            raise InputError(words, file=file, cure=CURE) from None
        if shipped.record == made_from(record, shipping.made_by):
            if not copied(file.parent, out, shipped.files):
                raise InputError("beside it are not the files that were shipped with the source", file=file, cure=CURE)
            return True
    return False


def ship(result: Path, record: Record, root: Path, shipping: Shipping) -> Path:
    """Put the files of `result`, a flat folder that `record` gave, into the package; returns where they are."""
    target, hashes = root / shipping.folder, {}
    target.mkdir(parents=True, exist_ok=True)
    for path in sorted(result.iterdir()):
        replace_file(target / path.name, path.read_bytes())
        hashes[path.name] = hash_of_file(target / path.name)
    replace_file(target / MADE_FROM, json_text(Shipped(made_from(record, shipping.made_by), hashes)).encode())
    return target
