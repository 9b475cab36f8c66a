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
        self.inside: dict[str, Path] = {}  # folders that were found to lie in it, by how they are written

    def __call__(self, key: str, found: str, cure: str) -> NoReturn:
        raise InputError(found, file=self.file, key=key, cure=cure)


def check_path(key: str, path: str, suffixes: Iterable[str], refuse: Refusal, must_exist: bool = True) -> None:
    """A path of a known suffix that leads to a plain file inside the dataset's folder, which may be read."""
    target = _inside(key, path, refuse, "file")
    if target.suffix.lower() not in suffixes:
        refuse(key, f"{path!r} has a suffix that is not read here", f"expected one of {', '.join(suffixes)}")
    if must_exist or is_there(target, key):
        check_file(key, path, target, refuse)


def check_file(key: str, path: str, target: Path, refuse: Refusal) -> None:
    """A plain file that may be read; `path` is how the user names it."""
    if not is_there(target, key):
        refuse(key, f"there is no file {path!r}", _nearby(target))
    try:
        check_plain(target, "a file", key, most_bytes=None)
    except InputError as error:
        refuse(key, f"{path!r} {error.found}", error.cure or "correct the path")


def check_folder(key: str, path: str, refuse: Refusal) -> Path:
    """A path that leads to a folder inside the dataset's, links followed, whose files can be listed."""
    folder = _inside(key, path, refuse, "folder")
    with reading("a folder", refuse.file, key):
        if not folder.is_dir():
            refuse(key, f"there is no folder {path!r}", "copy it there, or correct the path")
        os.scandir(folder).close()
    return folder


def file_of(key: str, folder: str, name: str, refuse: Refusal) -> Path | None:
    """The file `name` of a folder inside the dataset's; None where there is none.  It does not lead outside either."""
    target = _inside(key, f"{folder}/{name}", refuse, "file")
    if not is_there(target, key):
        return None
    check_file(key, f"{folder}/{name}", target, refuse)
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
    if above in refuse.inside and name not in ("", ".", "..") and _is_plain(found := refuse.inside[above] / name):
        return found
    try:
        target = path_inside(refuse.folder, path)
        if above and name not in ("", ".", ".."):
            refuse.inside[above] = path_inside(refuse.folder, above)
        return target
    except ValueError as error:
        shown = path if len(path) <= 80 else f"{path[:80]}…"
        fault = f"{shown!r} {error}"
        refuse(key, fault, f"copy the {kind} into {refuse.folder.resolve()} and name it relative to that folder")


def _is_plain(target: Path) -> bool:
    try:
        return stat.S_ISREG(os.lstat(target).st_mode)
    except (OSError, ValueError):
        return False


def _nearby(target: Path) -> str:
    try:
        names = [entry.name for entry in target.parent.iterdir() if entry.is_file()]
    except OSError:
        names = []
    cure = did_you_mean(target.name, names)
    return cure if cure.startswith("did") else f"put it at {target}, or correct the path"
