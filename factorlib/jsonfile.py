"""JSON on disk: sorted keys, shortest round-trip floats, no NaN, so that equal values are equal bytes."""

import json
import re
from pathlib import Path
from typing import Any, TypeVar, cast

import msgspec

from factorlib.errors import InputError
from factorlib.reading import read_text, reading
from factorlib.wholefile import write_text

T = TypeVar("T")
VERSION = 1  # version of the stages' files; a file without `version` has version 1, so it is not written
_WHERE = re.compile(r"^(?P<fault>.*?)(?: - at `(?:\$\.?)?(?P<key>[^`]*)`)?$", re.DOTALL)


def json_text(value: Any) -> str:
    r"""Return a value (plain, or msgspec structs) as indented JSON; ValueError for NaN and infinity.

    >>> json_text({"b": 1, "a": [0.1]})
    '{\n "a": [\n  0.1\n ],\n "b": 1\n}\n'
    """
    return json.dumps(msgspec.to_builtins(value), indent=1, sort_keys=True, ensure_ascii=False, allow_nan=False) + "\n"


def write_json(path: str | Path, value: Any) -> None:
    """Write a value as JSON, whole or not at all; ValueError for NaN and infinity."""
    write_text(path, json_text(value))


def read_json(path: str | Path) -> Any:
    """Read a JSON file; InputError if it cannot be read or is not JSON."""
    text = read_text(path, "JSON")
    with reading("JSON", path, cure="delete it and run its stage again"):
        return json.loads(text)


def read_result(path: str | Path, type_: type[T], stage: str, cure: str = "") -> T:
    """Read a JSON file of a stage as a value of a type; unknown keys are ignored.

    Args:
        path: the file
        type_: the type
        stage: the stage that writes the file
        cure: cure for a rejected file, by default to run the stage again

    Raises:
        InputError: The file is not JSON, has another version, or does not fit the type; the error names the key.
    """
    cure = cure or f"run the stage `{stage}` again"
    text = read_text(path, "JSON")
    with reading("JSON", path, cure=cure):
        content = msgspec.json.decode(text)
        # a table called `version` is the entry of a photo of that name
        has_version = isinstance(content, dict) and not isinstance(content.get("version", {}), dict | list)
        if has_version and (version := content.pop("version")) != VERSION:
            fault = f"is of version {version}; this program reads version {VERSION}"
            raise InputError(fault, file=path, key="version", cure=cure)
        try:
            return msgspec.convert(content, type_)
        except msgspec.ValidationError as error:
            match = cast(re.Match, _WHERE.match(str(error)))
            raise InputError(match["fault"], file=path, key=match["key"] or None, cure=cure) from None
