"""JSON of an earlier stage as typed structs; a damaged file, or one of another version, is an InputError."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from factorlib.errors import InputError
from factorlib.reading import read_text, reading

T = TypeVar("T")
VERSION = 1  # of the files of this package; a file without `version` is of version 1, so none is written
FINITE = {"ge": -1.7e308, "le": 1.7e308}  # bounds of `msgspec.Meta` that refuse infinity
_WHERE = re.compile(r"^(?P<found>.*?)(?: - at `(?:\$\.?)?(?P<key>[^`]*)`)?$", re.DOTALL)


def read_result(path: str | Path, type_: type[T], stage: str, cure: str = "") -> T:
    """The content of a JSON file as `type_`; keys that the type does not have are passed over.

    stage: the one that writes the file;  cure: what to do about a file that is refused, where running the stage again is not it
    Raises InputError, with the key, for a file that is no JSON, of another version, or without what the type needs.
    """
    cure, text = cure or f"run the stage `{stage}` again", read_text(path, "JSON")
    with reading("JSON", path, cure=cure):
        content = msgspec.json.decode(text)
    check_version(content, path, cure)
    return converted(content, type_, path, cure)


def converted(content: Any, type_: type[T], path: str | Path, cure: str) -> T:
    """Plain content as `type_`; InputError with the key of what does not fit."""
    with reading("JSON", path, cure=cure):
        try:
            return msgspec.convert(content, type_)
        except msgspec.ValidationError as error:
            found = _WHERE.match(str(error))
            raise InputError(found["found"], file=path, key=found["key"] or None, cure=cure) from None


def check_version(content: Any, path: str | Path, cure: str) -> None:
    """InputError where the file says a version that is not VERSION.  In files by photo, an entry called `version` is no number."""
    version = content.get("version", VERSION) if isinstance(content, dict) else VERSION
    if isinstance(version, dict | list) or version == VERSION:
        return
    raise InputError(f"is of version {version}; this program reads version {VERSION}", file=path, key="version", cure=cure)
