"""Results on disk: each tree of files by the hash of its content, each key pointing at the tree it gave.

    build/store/trees/<output>/   the files of a result, read-only
    build/store/keys/<key>.json   {"output", "record", "files"}: what the key gave
    build/store/logs/<key>.jsonl  what making it cost and said (times and machine facts are only here)
    build/store/views/<hash>/     the results of all photos of a stage in one folder
    build/store/unfinished/<key>/ what lets a step that was killed go on
    build/store/locks, tmp, cache

A tree and a key appear by one rename each, the tree first; nothing half-written is ever visible.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Mapping
from pathlib import Path

import msgspec

from factorlib.errors import InputError
from factorlib.jsonfile import read_json, write_json
from factorlib.runner.filehash import hash_of_file


class Entry(msgspec.Struct, frozen=True):
    """What a key gave: the hash of the tree, the record that made the key, and each file's hash."""

    output: str
    record: dict
    files: dict[str, str]


class Store:
    """The store of one build folder."""

    def __init__(self, root: Path):
        self.root = root
        self.trees, self.keys, self.logs, self.views, self.locks, self.tmp, self.cache, self.unfinished = (
            root / name for name in ("trees", "keys", "logs", "views", "locks", "tmp", "cache", "unfinished")
        )

    def entry(self, key: str) -> Entry | None:
        """The result of a key, None where it was never made or its tree is gone."""
        try:
            entry = msgspec.json.decode((self.keys / f"{key}.json").read_bytes(), type=Entry)
        except (FileNotFoundError, msgspec.DecodeError):
            return None
        return entry if self.tree(entry.output).is_dir() else None

    def tree(self, output: str) -> Path:
        return self.trees / output

    def log(self, key: str) -> Path:
        return self.logs / f"{key}.jsonl"

    def commit(self, key: str, record: dict, folder: Path) -> Entry:
        """Take the files of `folder` in as the result of `key`; the folder is gone afterwards."""
        files = hashes_of_tree(folder)
        entry = Entry(output_of(files), record, files)
        for name in files:
            _settle(folder / name)
        self.trees.mkdir(parents=True, exist_ok=True)
        _move(folder, self.tree(entry.output))
        self._write(self.keys / f"{key}.json", entry)
        return entry

    def _write(self, path: Path, value) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        draft = path.with_name(f"{path.name}.{os.getpid()}.draft")
        write_json(draft, value)
        os.replace(draft, path)


class Outputs(Mapping):
    """Output hash by key, each looked up once."""

    def __init__(self, store: Store):
        self.store = store
        self._known: dict[str, str] = {}

    def get(self, key, default=None):
        if key not in self._known:
            entry = self.store.entry(key)
            if entry is None:
                return default
            self._known[key] = entry.output
        return self._known[key]

    def forget(self, key: str) -> None:
        self._known.pop(key, None)

    def __getitem__(self, key):
        found = self.get(key)
        if found is None:
            raise KeyError(key)
        return found

    def __iter__(self):
        return (path.stem for path in self.store.keys.glob("*.json"))

    def __len__(self):
        return sum(1 for _ in self)


def hashes_of_tree(folder: Path) -> dict[str, str]:
    """{relative path: content hash} of every file below a folder, sorted; refuses links, which would lead out of it."""
    files = {}
    for path in sorted(folder.rglob("*")):
        if path.is_symlink():
            raise InputError(f"a stage left the link {path.name!r}", file=path, cure="write a file")
        if path.is_file():
            files[path.relative_to(folder).as_posix()] = hash_of_file(path)
    return files


def output_of(files: dict[str, str]) -> str:
    """The hash of a tree: of its files' names and contents."""
    return hashlib.sha256(json.dumps(files, sort_keys=True).encode()).hexdigest()[:32]


def _settle(path: Path) -> None:
    """On disk and read-only."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
    path.chmod(0o444)


def _move(folder: Path, target: Path) -> None:
    """One rename; where the same tree is there already, that one stays."""
    if not target.is_dir():
        try:
            os.rename(folder, target)
            return
        except OSError:
            if not target.is_dir():
                raise
    shutil.rmtree(folder)


# ── views: what build/<dataset>/<stage> names ────────────────────────────────────────────────────────────────────────


def view_of(store: Store, outputs: dict[str, str], gather: str | None) -> Path:
    """One folder with the files of all photos ({photo: output}), and `<photo>.json` of each gathered into `gather`."""
    target = store.views / hashlib.sha256(json.dumps([outputs, gather], sort_keys=True).encode()).hexdigest()[:32]
    if not target.is_dir():
        store.tmp.mkdir(parents=True, exist_ok=True)
        store.views.mkdir(parents=True, exist_ok=True)
        draft = store.tmp / f"view-{os.getpid()}-{target.name}"
        shutil.rmtree(draft, ignore_errors=True)
        _fill_view(draft, store, outputs, gather)
        _move(draft, target)
    return target


def _fill_view(draft: Path, store: Store, outputs: dict[str, str], gather: str | None) -> None:
    draft.mkdir()
    for photo, output in sorted(outputs.items()):
        tree = store.tree(output)
        for file in sorted(path for path in tree.rglob("*") if path.is_file()):
            target = draft / file.relative_to(tree)
            if target.exists():
                raise InputError(f"two photos write the same file {target.name!r}", key=photo, cure="put the photo's name into it")
            target.parent.mkdir(parents=True, exist_ok=True)
            _link(file, target)
    if gather:
        write_json(draft / gather, {photo: read_json(store.tree(output) / f"{photo}.json") for photo, output in outputs.items()})
        (draft / gather).chmod(0o444)


def _link(file: Path, target: Path) -> None:
    try:
        os.link(file, target)
    except OSError:  # no hard links on this file system
        shutil.copy2(file, target)


def point(link: Path, target: Path) -> None:
    """Make `link` name the folder `target` from one moment to the next; relative, so that build/ can be moved."""
    words = os.path.relpath(target, link.parent)
    if link.is_symlink() and os.readlink(link) == words:
        return
    link.parent.mkdir(parents=True, exist_ok=True)
    draft = link.with_name(f".{link.name}.{os.getpid()}")
    draft.unlink(missing_ok=True)
    os.symlink(words, draft, target_is_directory=True)
    if link.is_dir() and not link.is_symlink():
        raise InputError("is a folder of its own, where the runner puts a link", file=link, cure="move it elsewhere")
    os.replace(draft, link)
