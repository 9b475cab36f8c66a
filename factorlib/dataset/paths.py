"""Paths of a dataset: written relative to its folder, they stay inside it, links followed, and lead to plain files."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterable
from pathlib import Path
from typing import NoReturn

from factorlib.errors import InputError, did_you_mean
from factorlib.reading import check_plain, path_inside, reading


class Refusal:
    """The file that is being checked, the folder its paths stay in, and how to refuse a key of it."""

    def __init__(self, file: Path, folder: Path):
        self.file, self.folder = file, folder
        self.inside: dict[str, Path] = {}  # folders that have been followed and lie in it, by how they are written

    def __call__(self, key: str, fault: str, cure: str) -> NoReturn:
        raise InputError(fault, file=self.file, key=key, cure=cure)

    def known(self, key: str, name: str, known: Iterable[str], kind: str) -> None:
        """Refuse a name that is not among `known`, and suggest the nearest one."""
        if name not in (known := list(known)):
            cure = did_you_mean(name, known) if known else f"the dataset has no {kind} here"
            self(key, f"unknown {kind} {name!r}", cure)


def check_path(key: str, path: str, suffixes: Iterable[str], refuse: Refusal, must_exist: bool = True) -> None:
    """A path of a known suffix that leads to a plain file inside the dataset's folder, which may be read."""
    target = _inside(key, path, refuse, "file")
    if target.suffix.lower() not in suffixes:
        refuse(key, f"{path!r} has a suffix that is not read here", f"expected one of {', '.join(suffixes)}")
    if is_there(target, key):
        _check_file(key, path, target, refuse)
    elif must_exist:
        try:
            names = [entry.name for entry in target.parent.iterdir() if entry.is_file()]
        except OSError:
            names = []
        near = did_you_mean(target.name, names)
        cure = near if near.startswith("did") else f"put it at {target}, or correct the path"
        refuse(key, f"there is no file {path!r}", cure)


def _check_file(key: str, path: str, target: Path, refuse: Refusal) -> None:
    try:
        check_plain(target, "a file", key, most_bytes=None)
    except InputError as error:
        refuse(key, f"{path!r} {error.found}", error.cure or "correct the path")


def check_folder(key: str, path: str, refuse: Refusal) -> None:
    """A path that leads to a folder inside the dataset's, links followed, whose files can be listed."""
    folder = _inside(key, path, refuse, "folder")
    with reading("a folder", refuse.file, key):
        if not folder.is_dir():
            refuse(key, f"there is no folder {path!r}", "copy it there, or correct the path")
        os.scandir(folder).close()


def file_of(key: str, folder: str, name: str, refuse: Refusal) -> Path | None:
    """The file `name` of a folder inside the dataset's; None where there is none.  It does not lead outside either."""
    target = _inside(key, f"{folder}/{name}", refuse, "file")
    if not is_there(target, key):
        return None
    _check_file(key, f"{folder}/{name}", target, refuse)
    return target


def is_there(target: Path, key: str) -> bool:
    """Whether anything is there; InputError where that may not be known."""
    with reading("a file", target, key):
        try:
            os.stat(target)
        except (FileNotFoundError, NotADirectoryError):
            return False
    return True


def _inside(key: str, path: str, refuse: Refusal, kind: str) -> Path:
    """Files of one folder that are no links are where that folder is, which is followed once: a set may have thousands."""
    above, _, name = path.rpartition("/")
    plain_name = name not in ("", ".", "..")
    try:
        if plain_name and above in refuse.inside and stat.S_ISREG(os.lstat(refuse.inside[above] / name).st_mode):
            return refuse.inside[above] / name
    except (OSError, ValueError):
        pass  # for the rest to say
    try:
        target = path_inside(refuse.folder, path)
        if above and plain_name:
            refuse.inside[above] = path_inside(refuse.folder, above)
        return target
    except ValueError as error:
        fault = f"{path if len(path) <= 80 else f'{path[:80]}…'!r} {error}"
        refuse(key, fault, f"copy the {kind} into {refuse.folder.resolve()} and name it relative to that folder")
