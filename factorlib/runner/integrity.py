"""Whether results are as they were kept: size and time of each file first, contents where those are not the known ones.

A tree is right if its files are exactly those of its record, with their contents; what an editor or a desktop leaves
(`left_over`) is no part of it.  Which sizes and times a tree had when its contents were found right is remembered in a
cache, so that a tree is read once.  A byte that flips under the same size and time is found by `thorough` alone.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator, Mapping
from pathlib import Path

import msgspec

from factorlib.errors import InputError
from factorlib.runner.filehash import hash_of_file, left_over, write_cache

Stamp = tuple[int, int]  # size in bytes, time of the content in ns
NO_FILE: Stamp = (-1, 0)  # a link, a pipe: nothing that a stage writes
SHOWN = 3  # files of one result that are named


def stamps_of(folder: Path) -> dict[str, Stamp]:
    """{relative path: stamp} of what lies below a folder; empty where there is none."""
    return {name: _stamp(entry) for name, entry in _entries(folder, "")}


def _entries(folder: str | Path, above: str) -> Iterator[tuple[str, os.DirEntry]]:
    try:
        found = [entry for entry in os.scandir(folder) if not left_over(entry.name)]
    except (FileNotFoundError, NotADirectoryError):
        return
    for entry in found:
        if entry.is_dir(follow_symlinks=False):
            yield from _entries(entry.path, f"{above}{entry.name}/")
        else:
            yield above + entry.name, entry


def _stamp(entry: os.DirEntry) -> Stamp:
    try:
        found = entry.stat(follow_symlinks=False)
    except FileNotFoundError:
        return NO_FILE
    return (found.st_size, found.st_mtime_ns) if stat.S_ISREG(found.st_mode) else NO_FILE


def hashes_of_tree(folder: Path) -> dict[str, str]:
    """{relative path: content hash} of every file below a folder, sorted; refuses links, which would lead out of it."""
    files = {}
    for name, stamp in sorted(stamps_of(folder).items()):
        if stamp == NO_FILE:
            raise InputError(f"a stage left {name!r}, which is no file", file=folder / name, cure="write a file")
        files[name] = hash_of_file(folder / name)
    return files


class Inspector:
    """Looks at the trees and views of a store.

    known: by tree, the stamps of its files when their contents were right
    """

    def __init__(self, root: Path):
        self.trees, self.views, self.cache = root / "trees", root / "views", root / "cache" / "trees.json"
        self.known: dict[str, dict[str, Stamp]] = self._read()
        self._wrong: dict[str, tuple[dict[str, Stamp], list[str]]] = {}
        self._changed = False

    def damage(self, output: str, files: Mapping[str, str]) -> list[str]:
        """What is wrong with a tree that should hold `files` (relative path -> hash), a line each; empty where nothing is."""
        now = stamps_of(self.trees / output)
        if now and now == self.known.get(output):
            return []
        if output not in self._wrong or self._wrong[output][0] != now:
            self._judge(output, files, now, self.known.get(output, {}))
        return self._wrong[output][1] if output in self._wrong else []

    def thorough(self, output: str, files: Mapping[str, str]) -> list[str]:
        """The same, with every content read."""
        self._judge(output, files, stamps_of(self.trees / output), {})
        return self._wrong[output][1] if output in self._wrong else []

    def _judge(self, output: str, files: Mapping[str, str], now: dict[str, Stamp], right: Mapping[str, Stamp]) -> None:
        found = [line for name in sorted(files) if (line := self._of_file(output, name, files[name], now, right))]
        found += [f"{name}: no file of this result" for name in sorted(now.keys() - files.keys())]
        if found:
            self._wrong[output] = now, found
            self._forget(output)
        else:
            self._wrong.pop(output, None)
            self.remember(output, now)

    def _of_file(
        self, output: str, name: str, hash_: str, now: Mapping[str, Stamp], right: Mapping[str, Stamp]
    ) -> str | None:
        if name not in now:
            return f"{name}: missing"
        if now[name] == right.get(name):
            return None
        if now[name] == NO_FILE:
            return f"{name}: a link, or no file"
        try:
            return None if hash_of_file(self.trees / output / name) == hash_ else f"{name}: other content"
        except OSError as error:
            return f"{name}: cannot be read ({error.strerror})"

    def remember(self, name: str, stamps: dict[str, Stamp]) -> None:
        """Note the stamps of a tree whose contents were right."""
        if self.known.get(name) != stamps:
            self.known[name], self._changed = stamps, True

    def _forget(self, name: str) -> None:
        self._changed |= self.known.pop(name, None) is not None

    def _read(self) -> dict[str, dict[str, Stamp]]:
        try:
            return msgspec.json.decode(self.cache.read_bytes(), type=dict[str, dict[str, Stamp]])
        except (OSError, msgspec.DecodeError):
            return {}

    def save(self) -> None:
        """Write the cache, where there is anything new to write."""
        if not self._changed:
            return
        there = {
            name: stamps
            for name, stamps in self.known.items()
            if (self.trees / name).is_dir() or (self.views / name).is_dir()
        }
        write_cache(self.cache, there)
        self._changed = False


def in_short(damage: list[str]) -> str:
    """
    >>> in_short(["a: missing", "b: missing", "c: missing", "d: missing"])
    'a: missing; b: missing; c: missing; 1 more'
    """
    more = [f"{len(damage) - SHOWN} more"] if len(damage) > SHOWN else []
    return "; ".join([*damage[:SHOWN], *more])
