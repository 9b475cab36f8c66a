"""JSON on disk: sorted keys, shortest round-trip floats, no NaN, so that the same value is the same bytes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import msgspec

from factorlib.reading import read_text, reading
from factorlib.wholefile import write_text


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
