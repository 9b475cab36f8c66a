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
_WHERE = re.compile(r"^(?P<found>.*?)(?: - at `(?:\$\.?)?(?P<key>[^`]*)`)?$", re.DOTALL)


def read_result(path: str | Path, type_: type[T], stage: str, cure: str = "") -> T:
    """The content of a JSON file as `type_`; keys that the type does not have are passed over.

    stage: the one that writes the file;  cure: what to do about a file that is refused, where running the stage again is not it
    Raises InputError, with the key, for a file that is no JSON, of another version, or without what the type needs.
    """
    cure, text = cure or f"run the stage `{stage}` again", read_text(path, "JSON")
    with reading("JSON", path, cure=cure):
        content = msgspec.json.decode(text)
    return converted(of_this_version(content, path, cure), type_, path, cure)


def converted(content: Any, type_: type[T], path: str | Path, cure: str) -> T:
    """Plain content as `type_`; InputError with the key of what does not fit."""
    with reading("JSON", path, cure=cure):
        try:
            return msgspec.convert(content, type_)
        except msgspec.ValidationError as error:
            found = _WHERE.match(str(error))
            raise InputError(found["found"], file=path, key=found["key"] or None, cure=cure) from None


def of_this_version(content: Any, path: str | Path, cure: str) -> Any:
    """The content without its `version`; InputError where that is not VERSION.  In files by photo, an entry of that name is no number."""
    if not isinstance(content, dict) or isinstance(content.get("version", {}), dict | list):
        return content
    if content["version"] != VERSION:
        found = f"is of version {content['version']}; this program reads version {VERSION}"
        raise InputError(found, file=path, key="version", cure=cure)
    return {name: value for name, value in content.items() if name != "version"}
