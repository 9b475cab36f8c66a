"""Versions of the packages whose numbers matter: those that the source of a stage imports."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import msgspec

from factorlib.runner.filehash import write_cache


class _Stored(msgspec.Struct):
    """The cache: the state of site-packages, and by import name {distribution: version}."""

    state: list
    versions: dict[str, dict[str, str]]


class Packages:
    """Import name -> "distribution version", looked up once per state of site-packages."""

    def __init__(self, cache: Path | None):
        self.cache = cache
        self.state = [
            [path, os.stat(path).st_mtime_ns] for path in sys.path if path.endswith("-packages") and os.path.isdir(path)
        ]
        self._known = self._read()
        self._names: dict | None = None
        self._changed = False

    def versions(self, imports: list[str]) -> dict[str, str]:
        """{distribution: version}; what belongs to no distribution is left out."""
        found = [self._of(name) for name in imports]
        return {name: version for pair in found for name, version in pair.items()}

    def _of(self, name: str) -> dict[str, str]:
        if name not in self._known:
            self._known[name], self._changed = self._look_up(name), True
        return self._known[name]

    def _look_up(self, name: str) -> dict[str, str]:
        from importlib.metadata import packages_distributions, version

        if self._names is None:
            self._names = packages_distributions()
        return {found: version(found) for found in sorted(set(self._names.get(name, [])))}

    def _read(self) -> dict:
        try:
            stored = msgspec.json.decode(self.cache.read_bytes(), type=_Stored)
            return stored.versions if stored.state == self.state else {}
        except (AttributeError, OSError, msgspec.DecodeError, RecursionError):
            return {}

    def save(self) -> None:
        """Write the cache, where there is anything new to write."""
        if self._changed and self.cache is not None:
            write_cache(self.cache, {"state": self.state, "versions": self._known})
            self._changed = False
