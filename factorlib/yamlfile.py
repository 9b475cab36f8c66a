"""YAML read strictly: numbers as in YAML 1.2, no key twice, no key unknown, every complaint with file, line and key.

PyYAML reads `1e-3` as a string and `no` as False, and lets a duplicate key win silently; here scalars follow YAML 1.2's
core schema, mapping keys are always text, and what is read is converted to typed structs by msgspec.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import msgspec
import yaml

from factorlib.errors import InputError, did_you_mean

T = TypeVar("T")
Keys = tuple[str | int, ...]  # the way to a value: mapping keys and list indices from the root

_STR, _NULL, _BOOL, _INT, _FLOAT = (f"tag:yaml.org,2002:{kind}" for kind in ("str", "null", "bool", "int", "float"))
_CORE = [  # YAML 1.2.2, section 10.3.2
    (_NULL, r"~|null|Null|NULL|"),
    (_BOOL, r"true|True|TRUE|false|False|FALSE"),
    (_INT, r"[-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+"),
    (_FLOAT, r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)"),
]


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):
    yaml_implicit_resolvers: ClassVar[dict] = {}


for _tag, _pattern in _CORE:
    _Loader.add_implicit_resolver(_tag, re.compile(rf"^(?:{_pattern})$"), None)


def read_yaml(path: str | Path, type_: type[T]) -> T:
    """The file as a value of a msgspec type; InputError with file, line, key and cure for whatever does not fit."""
    text = _text_of(path)
    value, lines = _load(text, path)
    return _convert(value, type_, path, lines)


def load_yaml(path: str | Path) -> Any:
    """The file as dicts, lists and scalars."""
    return _load(_text_of(path), path)[0]


def parse_yaml(text: str, name: str | Path = "") -> Any:
    """The same of a text; `name` is what errors call it.

    >>> parse_yaml("{a: 1e-3, b: no, c: [1, ~, true]}")
    {'a': 0.001, 'b': 'no', 'c': [1, None, True]}
    """
    return _load(text, name)[0]


def convert(value: Any, type_: type[T], name: str | Path, prefix: str = "") -> T:
    """Plain data, wherever it came from, as a value of a msgspec type; errors as in `read_yaml`, `prefix` before keys."""
    return _convert(value, type_, name, {}, prefix)


def _text_of(path: str | Path) -> str:
    try:
        return Path(path).read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"not UTF-8 text (byte {error.start})", file=path, cure="save it as UTF-8") from error
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror})", file=path, cure="check the name and its permissions") from error


def _load(text: str, path: str | Path) -> tuple[Any, dict[Keys, int]]:
    """The plain value, and the line each part of it stands on."""
    lines: dict[Keys, int] = {}
    try:
        loader = _Loader(text)
        try:
            node = loader.get_single_node()
        finally:
            loader.dispose()
    except yaml.YAMLError as error:
        raise _syntax_error(error, path) from error
    return (None if node is None else _value_of(node, (), lines, path, ())), lines


def _syntax_error(error: yaml.YAMLError, path: str | Path) -> InputError:
    mark, problem = getattr(error, "problem_mark", None), getattr(error, "problem", None) or str(error)
    context = getattr(error, "context", None)
    found = f"not YAML: {problem}" + (f" {context}" if context else "")
    return InputError(
        found, file=_at(path, mark.line + 1 if mark else None), cure="look for a bracket, quote, colon or indent on or above this line"
    )


def _value_of(node: yaml.Node, keys: Keys, lines: dict[Keys, int], path: str | Path, above: tuple) -> Any:
    lines[keys] = node.start_mark.line + 1
    if node in above:
        raise InputError("an alias that contains itself", file=_at(path, lines[keys]), key=key_path(keys), cure="write the value out")
    if isinstance(node, yaml.ScalarNode):
        return _scalar(node, keys, path)
    if isinstance(node, yaml.SequenceNode):
        return [_value_of(item, (*keys, i), lines, path, (*above, node)) for i, item in enumerate(node.value)]
    return _mapping(node, keys, lines, path, (*above, node))


def _mapping(node: yaml.MappingNode, keys: Keys, lines: dict[Keys, int], path: str | Path, above: tuple) -> dict:
    values: dict[str, Any] = {}
    for key_node, value_node in node.value:
        line = key_node.start_mark.line + 1
        if not isinstance(key_node, yaml.ScalarNode):
            raise InputError("a key that is not a word", file=_at(path, line), key=key_path(keys), cure="write key: value")
        key = key_node.value
        if key in values:
            found = f"the key {key!r} stands here twice, first on line {lines[(*keys, key)]}"
            raise InputError(found, file=_at(path, line), key=key_path((*keys, key)), cure="delete or rename one of them")
        values[key] = _value_of(value_node, (*keys, key), lines, path, above)
        lines[(*keys, key)] = line
    return values


def _scalar(node: yaml.ScalarNode, keys: Keys, path: str | Path) -> Any:
    text, tag = node.value, node.tag
    if tag == _STR:
        return text
    if tag == _NULL:
        return None
    if tag == _BOOL:
        return text.lower() == "true"
    if tag == _INT:
        return int(text, 0) if text[:2] in ("0o", "0x") else int(text)
    if tag == _FLOAT:
        return float(text.lower().replace(".inf", "inf").replace(".nan", "nan"))
    where = _at(path, node.start_mark.line + 1)
    raise InputError(f"the tag {tag!r} is not known", file=where, key=key_path(keys), cure="delete the tag")


def key_path(keys: Keys) -> str | None:
    """How errors write the way to a value.

    >>> key_path(("photos", 0, "masks"))
    'photos[0].masks'
    """
    text = "".join(f"[{key}]" if isinstance(key, int) else f".{key}" for key in keys)
    return text.removeprefix(".") or None


def _at(path: str | Path, line: int | None) -> str:
    return f"{path}:{line}" if line else str(path)


# ── to typed structs ─────────────────────────────────────────────────────────────────────────────────────────────────

_MESSAGE = re.compile(r"^(?P<found>.*?)(?: - at `(?P<where>[^`]*)`)?$", re.DOTALL)
_STEP = re.compile(r"\.(?P<name>[^.\[]+)|\[(?P<index>\d+|\.\.\.)\]")
_UNKNOWN = re.compile(r"unknown field `(.*)`")
_MISSING = re.compile(r"missing required field `(.*)`")


def _convert(value: Any, type_: type[T], path: str | Path, lines: dict[Keys, int], prefix: str = "") -> T:
    try:
        return msgspec.convert(value, type_)
    except msgspec.ValidationError as error:
        message, keys = _found_at(str(error), value, type_)
        raise _refusal(message, keys, value, type_, path, lines, prefix) from None


def _found_at(error: str, value: Any, type_: type) -> tuple[str, Keys]:
    """msgspec's message and where it points; it calls every key of a dict `[...]`, so the guilty one is tried for."""
    match = _MESSAGE.match(error)
    keys: Keys = ()
    for step in _STEP.finditer((match["where"] or "$").removeprefix("key in ")):
        if step["index"] == "...":
            keys = (*keys, _guilty_key(keys, value, type_))
        else:
            keys = (*keys, int(step["index"]) if step["index"] else step["name"])
    return match["found"], keys


def _guilty_key(keys: Keys, value: Any, type_: type) -> str:
    table = _at_keys(value, keys)
    for key in table:
        try:
            msgspec.convert(_with(value, keys, {key: table[key]}), type_)
        except msgspec.ValidationError:
            return key
    return next(iter(table))


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


def _refusal(message: str, keys: Keys, value: Any, type_: type, path, lines: dict[Keys, int], prefix: str) -> InputError:
    if unknown := _UNKNOWN.search(message):
        keys = (*keys, unknown[1])
        message, cure = f"unknown key {unknown[1]!r}", did_you_mean(unknown[1], _fields_at(type_, keys[:-1]))
    elif missing := _MISSING.search(message):
        message, cure = f"the key {missing[1]!r} is missing", f"add {missing[1]}: …"
    else:
        given = _at_keys(value, keys)
        message = f"{message[:1].lower()}{message[1:]}" + (f": {given!r}" if not isinstance(given, dict | list) else "")
        quoted = isinstance(given, int | float) and "expected `str" in message
        cure = f'put it in quotes: "{given}"' if quoted else _choices(type_, keys) or "write a value of that kind"
    key = ".".join(part for part in (prefix, key_path(keys)) if part)
    return InputError(message, file=_at(path, lines.get(keys)), key=key or None, cure=cure)


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
