"""JSON on disk: sorted keys, shortest round-trip floats, no NaN, so that the same value is the same bytes."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from factorlib.errors import InputError
from factorlib.reading import read_text, reading
from factorlib.wholefile import write_text

T = TypeVar("T")
VERSION = 1  # of the files that stages hand on; a file without `version` is of version 1, so none is written
_WHERE = re.compile(r"^(?P<found>.*?)(?: - at `(?:\$\.?)?(?P<key>[^`]*)`)?$", re.DOTALL)


def json_text(value: Any) -> str:
    """`value` (plain, or msgspec structs) as indented JSON; raises ValueError for NaN and infinity.

    >>> json_text({"b": 1, "a": [0.1]})
    '{\\n "a": [\\n  0.1\\n ],\\n "b": 1\\n}\\n'
    """
    return json.dumps(msgspec.to_builtins(value), indent=1, sort_keys=True, ensure_ascii=False, allow_nan=False) + "\n"


def write_json(path: str | Path, value: Any) -> None:
    """Write `value` as JSON, whole or not at all; ValueError for NaN and infinities."""
    write_text(path, json_text(value))


def read_json(path: str | Path) -> Any:
    """The value; InputError for a file that is none."""
    text = read_text(path, "JSON")
    with reading("JSON", path, cure="delete it and run its stage again"):
        return json.loads(text)


def read_result(path: str | Path, type_: type[T], stage: str, cure: str = "") -> T:
    """The content of a JSON file as `type_`; keys that the type does not have are passed over.

    stage: the one that writes the file;  cure: what to do about a file that is refused, where running the stage again is not it
    Raises InputError, with the key, for a file that is no JSON, of another version, or without what the type needs.
    """
    cure, text = cure or f"run the stage `{stage}` again", read_text(path, "JSON")
    with reading("JSON", path, cure=cure):
        content = msgspec.json.decode(text)
        # a dict of that name is a photo's
        said = isinstance(content, dict) and not isinstance(content.get("version", {}), dict | list)
        if said and (version := content.pop("version")) != VERSION:
            found = f"is of version {version}; this program reads version {VERSION}"
            raise InputError(found, file=path, key="version", cure=cure)
        try:
            return msgspec.convert(content, type_)
        except msgspec.ValidationError as error:
            found = _WHERE.match(str(error))
            raise InputError(found["found"], file=path, key=found["key"] or None, cure=cure) from None
