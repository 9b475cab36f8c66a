"""Results that ship with the source: what a stage made once, kept where the package is, with what it was made from.

A step takes the shipped result where its parameters, and the sources of the modules that make it, are those that it was made from;
FORCE=1 makes it anew.  `python -m factorlib ship <stage>` ships the current result.
"""

from __future__ import annotations

import shutil
from pathlib import Path

import msgspec

from factorlib.errors import InputError
from factorlib.jsonfile import json_text
from factorlib.runner.filehash import hash_of_file
from factorlib.runner.pipeline import Shipping
from factorlib.runner.plan import Record
from factorlib.wholefile import replace_file

MADE_FROM = "made_from.json"
CURE = "restore it from the repository, or make the result anew with FORCE=1"


def made_from(record: Record, modules: list[str]) -> Record:
    """The part of a step's record that a result made by `modules` depends on.

    >>> made_from({"param:steps": 3, "source:stages.train": "1", "source:factorlib.errors": "2", "package:torch": "2.13"}, ["stages.train"])
    {'param:steps': 3, 'source:stages.train': '1'}
    """
    own = {f"source:{module}" for module in modules}
    return {name: value for name, value in record.items() if name.startswith("param:") or name in own}


class Shipped(msgspec.Struct, frozen=True):
    """What made_from.json says: the record, as far as the result depends on it, and the hash of each file."""

    record: Record
    files: dict[str, str]


def shipped_folder(roots: list[Path], shipping: Shipping, record: Record) -> Path | None:
    """The folder, below one of `roots`, whose result is that of `record`; None where it was made from something else.

    Raises InputError where a file in it is not the one that was shipped.
    """
    for path in (root / shipping.folder for root in roots if (root / shipping.folder / MADE_FROM).is_file()):
        shipped = _read(path)
        if shipped.record == made_from(record, shipping.made_by):
            _check_whole(path, shipped)
            return path
    return None


def _read(folder: Path) -> Shipped:
    try:
        return msgspec.json.decode((folder / MADE_FROM).read_bytes(), type=Shipped)
    except msgspec.DecodeError as error:
        raise InputError(f"does not say what the shipped files were made from ({error})", file=folder / MADE_FROM, cure=CURE) from None


def _check_whole(folder: Path, shipped: Shipped) -> None:
    for name, digest in shipped.files.items():
        if not (folder / name).is_file() or hash_of_file(folder / name) != digest:
            raise InputError("is not the file that was shipped with the source", file=folder / name, cure=CURE)


def copy_shipped(folder: Path, out: Path) -> None:
    """The files of a shipped result, as the step's own."""
    for name in _read(folder).files:
        shutil.copyfile(folder / name, out / name)


def ship(result: Path, record: Record, root: Path, shipping: Shipping) -> Path:
    """Put the files of `result`, a flat folder that `record` gave, into the package; returns where they are."""
    target = root / shipping.folder
    target.mkdir(parents=True, exist_ok=True)
    files = {path.name: path.read_bytes() for path in sorted(result.iterdir())}
    for name, content in files.items():
        replace_file(target / name, content)
    shipped = Shipped(made_from(record, shipping.made_by), {name: hash_of_file(target / name) for name in files})
    replace_file(target / MADE_FROM, json_text(shipped).encode())
    return target
