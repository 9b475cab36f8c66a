"""YAML files as typed structs: read strictly, no key unknown, every complaint with file, line and key.

PyYAML reads `1e-3` as a string and `no` as False, and lets a duplicate key win silently; `yamltext` does not.  What it reads
is converted by msgspec, whose complaints are put into the user's terms here.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from factorlib.errors import InputError, did_you_mean
from factorlib.reading import one_line, read_text
from factorlib.yamltext import LIMITS, Keys, Limits, at_line, key_path, line_of, plain_value

T = TypeVar("T")


class Source(msgspec.Struct, frozen=True):
    """Where a value was written: file (or what errors call it), its text, if lines are to be named, and a prefix of its keys."""

    path: str | Path
    text: str | None = None
    prefix: str = ""


def read_yaml(path: str | Path, type_: type[T], limits: Limits = LIMITS) -> T:
    """The file as a value of a msgspec type; InputError with file, line, key and cure for whatever does not fit."""
    text = _text_of(path, limits)
    return _convert(plain_value(text, path, limits), type_, Source(path, text))


def load_yaml(path: str | Path) -> Any:
    """The file as dicts, lists and scalars."""
    return plain_value(_text_of(path, LIMITS), path)


def parse_yaml(text: str, name: str | Path = "") -> Any:
    """The same of a text; `name` is what errors call it.

    >>> parse_yaml("{a: 1e-3, b: no, c: [1, ~, true]}")
    {'a': 0.001, 'b': 'no', 'c': [1, None, True]}
    """
    return plain_value(text, name)


def convert(value: Any, type_: type[T], name: str | Path, prefix: str = "") -> T:
    """Plain data, wherever it came from, as a value of a msgspec type; errors as in `read_yaml`, `prefix` before keys."""
    return _convert(value, type_, Source(name, prefix=prefix))


def _text_of(path: str | Path, limits: Limits) -> str:
    return read_text(path, "a YAML file", most_bytes=round(limits.megabytes * 1e6))


_MESSAGE = re.compile(r"^(?P<found>.*?)(?: - at `(?P<where>[^`]*)`)?$", re.DOTALL)
_STEP = re.compile(r"\.(?P<name>[^.\[]+)|\[(?P<index>\d+|\.\.\.)\]")
_UNKNOWN = re.compile(r"unknown field `(.*)`", re.DOTALL)
_MISSING = re.compile(r"missing required field `(.*)`", re.DOTALL)


def _convert(value: Any, type_: type[T], source: Source) -> T:
    try:
        return msgspec.convert(value, type_)
    except msgspec.ValidationError as error:
        message, keys = _found_at(str(error), value, type_)
        raise _refusal(message, keys, value, type_, source) from None


def _found_at(error: str, value: Any, type_: type) -> tuple[str, Keys]:
    """msgspec's message and where it points; it calls every key of a dict `[...]`, so the guilty one is looked for."""
    match = _MESSAGE.match(error)
    keys: Keys = ()
    try:
        for step in _STEP.finditer((match["where"] or "$").removeprefix("key in ")):
            if step["index"] == "...":
                keys = (*keys, _guilty_key(error, keys, value, type_))
            else:
                keys = (*keys, int(step["index"]) if step["index"] else step["name"])
            _at_keys(value, keys)
    except (LookupError, TypeError):  # a key of the user's that looks like msgspec's own words
        return error, ()
    return match["found"], keys


def _guilty_key(error: str, keys: Keys, value: Any, type_: type) -> str:
    """The first key of the dict at `keys` without which msgspec would not say `error`: found by halving."""
    table = _at_keys(value, keys)
    names = list(table)
    while len(names) > 1:
        half = names[: len(names) // 2]
        names = half if _complaint(_with(value, keys, {key: table[key] for key in half}), type_) == error else names[len(half) :]
    return names[0]


def _complaint(value: Any, type_: type) -> str | None:
    try:
        msgspec.convert(value, type_)
    except msgspec.ValidationError as error:
        return str(error)
    return None


def _at_keys(value: Any, keys: Keys) -> Any:
    for key in keys:
        value = value[key]
    return value


def _with(value: Any, keys: Keys, new: Any) -> Any:
    """A copy of `value` in which `new` stands at `keys`."""
    if not keys:
        return new
    copy = value.copy()
    copy[keys[0]] = _with(value[keys[0]], keys[1:], new)
    return copy


def _refusal(message: str, keys: Keys, value: Any, type_: type, source: Source) -> InputError:
    """msgspec's message in the user's terms, with file, line, key and cure."""
    if unknown := _UNKNOWN.search(message):
        keys = (*keys, unknown[1])
        message, cure = f"unknown key {one_line(repr(unknown[1]))}", did_you_mean(unknown[1], _fields_at(type_, keys[:-1]))
    elif missing := _MISSING.search(message):
        message, cure = f"the key {missing[1]!r} is missing", f"add {missing[1]}: …"
    else:
        given = _at_keys(value, keys)
        message = f"{message[:1].lower()}{message[1:]}" + (f": {one_line(repr(given))}" if not isinstance(given, dict | list) else "")
        quoted = isinstance(given, int | float) and "expected `str" in message
        cure = f'put it in quotes: "{one_line(str(given))}"' if quoted else _choices(type_, keys) or "write a value of that kind"
    key = ".".join(part for part in (source.prefix, key_path(keys)) if part)
    line = line_of(source.text, keys) if source.text is not None else None
    return InputError(message, file=at_line(source.path, line), key=key or None, cure=cure)


def _choices(type_: type, keys: Keys) -> str | None:
    """What may be written where only some words may."""
    from msgspec import inspect

    words = [word for info in _alternatives(_types_at(type_, keys)) if isinstance(info, inspect.LiteralType) for word in info.values]
    return f"one of {', '.join(map(str, words))}" if words else None


def _types_at(type_: type, keys: Keys) -> list:
    """What may stand where `keys` lead to."""
    from msgspec import inspect

    here = [inspect.type_info(type_)]
    for key in keys:
        here = [below for info in _alternatives(here) for below in _below(info, key)]
    return here


def _fields_at(type_: type, keys: Keys) -> list[str]:
    """Names of the fields of the struct that `keys` lead to."""
    from msgspec import inspect

    here = _types_at(type_, keys)
    return [field.encode_name for info in _alternatives(here) if isinstance(info, inspect.StructType) for field in info.fields]


def _alternatives(infos: list) -> list:
    from msgspec import inspect

    return [one for info in infos for one in (_alternatives(list(info.types)) if isinstance(info, inspect.UnionType) else [info])]


def _below(info: Any, key: str | int) -> list:
    from msgspec import inspect

    if isinstance(info, inspect.StructType):
        return [field.type for field in info.fields if field.encode_name == key]
    if isinstance(info, inspect.DictType):
        return [info.value_type]
    if isinstance(info, inspect.TupleType):
        return [info.item_types[key]] if isinstance(key, int) and key < len(info.item_types) else []
    return [info.item_type] if hasattr(info, "item_type") else []
