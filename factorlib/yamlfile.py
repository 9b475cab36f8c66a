"""YAML files as typed structs: scalars as in YAML 1.2, no key twice or unknown, every complaint with file, line and key.

PyYAML reads `1e-3` as a string and `no` as False, and lets a duplicate key win silently, so only its events are used.  The
value is built from them as they come: what is nested without end, grows without end through aliases, or is merely huge is
refused when it passes a limit, not when memory or the stack is full.  msgspec converts the value to its type.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NoReturn, TypeVar

import msgspec
import yaml
from msgspec import inspect

from factorlib.errors import InputError, did_you_mean
from factorlib.reading import one_line, read_text

T = TypeVar("T")
Keys = tuple[str | int, ...]  # the way to a value: mapping keys and list indices from the root
_TAG = "tag:yaml.org,2002:"
_CORE = re.compile(  # YAML 1.2.2, section 10.3.2
    r"(?P<null>~|null|Null|NULL|)|(?P<bool>true|True|TRUE|false|False|FALSE)|(?P<int>[-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+)"
    r"|(?P<float>[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN))"
)
_Parser = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class Limits(msgspec.Struct, frozen=True):
    """What a file may hold, far above a dataset of ten thousand photos.

    values: scalars, lists and maps, those that aliases repeat counted each time;  depth: of lists and maps in each other
    """

    megabytes: float = 64.0
    values: int = 2_000_000
    depth: int = 64
    digits: int = 300


LIMITS = Limits()


def read_yaml(path: str | Path, type_: type[T], limits: Limits = LIMITS) -> T:
    """The file as a value of a msgspec type; InputError with file, line, key and cure for whatever does not fit."""
    text = _text_of(path, limits)
    return convert(parse_yaml(text, path, limits), type_, path, text=text)


def load_yaml(path: str | Path) -> Any:
    """The file as dicts, lists and scalars."""
    return parse_yaml(_text_of(path, LIMITS), path)


def _text_of(path: str | Path, limits: Limits) -> str:
    return read_text(path, "a YAML file", most_bytes=round(limits.megabytes * 1e6))


def parse_yaml(text: str, name: str | Path = "", limits: Limits = LIMITS) -> Any:
    """The text's one document as dicts, lists and scalars; InputError names line, key and `name`, which errors call the text.

    >>> parse_yaml("{a: 1e-3, b: no, c: [1, ~, true]}")
    {'a': 0.001, 'b': 'no', 'c': [1, None, True]}
    """
    return _Document(text, name, limits).value()


class _Document:
    """One pass over the events of a text.  sought: the keys whose line is looked for."""

    def __init__(self, text: str, path: str | Path, limits: Limits, sought: Keys = ()):
        self.path, self.limits, self.sought, self.line = path, limits, sought, 1
        self.count, self.anchors, self.open = 0, {}, set()
        self.events = self._events(text)

    def _events(self, text: str) -> Iterator[yaml.Event]:
        try:
            parser = _Parser(text)
            try:
                while parser.check_event():
                    yield parser.get_event()
            finally:
                parser.dispose()
        except yaml.YAMLError as error:
            mark, context = getattr(error, "problem_mark", None), getattr(error, "context", None)
            words = " ".join(
                one_line(part) for part in (getattr(error, "problem", None) or str(error), context) if part
            )
            file = f"{self.path}:{mark.line + 1}" if mark else self.path
            cure = "look for a bracket, quote, colon or indent on or above this line"
            raise InputError(f"not YAML: {words}", file=file, cure=cure) from error

    def value(self) -> Any:
        """The value of the one document in the text, None for an empty text.  InputError where there is a second."""
        next(self.events)  # the stream
        if isinstance(next(self.events), yaml.StreamEndEvent):
            return None
        first = next(self.events)
        self._note((), first)
        value = self._node(first, ())
        next(self.events)  # the document's end
        if not isinstance(after := next(self.events), yaml.StreamEndEvent):
            self._refuse("there is a second document", after, (), "delete it, and the --- before it")
        return value

    def _note(self, keys: Keys, event: yaml.Event) -> None:
        if self.sought[: len(keys)] == keys:
            self.line = event.start_mark.line + 1

    def _node(self, event: yaml.Event, keys: Keys) -> Any:
        if isinstance(event, yaml.AliasEvent):
            return self._repeated(self._anchored(event, keys), event, keys)
        self._spend(event, keys)
        self.open.add(event.anchor)
        if isinstance(event, yaml.ScalarEvent):
            value = self._scalar(event, keys)
        else:
            value = (self._list if isinstance(event, yaml.SequenceStartEvent) else self._map)(event, keys)
        self.open.discard(event.anchor)
        self.anchors[event.anchor] = value
        return value

    def _list(self, start: yaml.Event, keys: Keys) -> list:
        self._check_tag(start, keys, "seq")
        values: list = []
        while not isinstance(event := next(self.events), yaml.SequenceEndEvent):
            self._note((*keys, len(values)), event)
            values.append(self._node(event, (*keys, len(values))))
        return values

    def _map(self, start: yaml.Event, keys: Keys) -> dict[str, Any]:
        self._check_tag(start, keys, "map")
        values: dict[str, Any] = {}
        lines: dict[str, int] = {}
        while not isinstance(event := next(self.events), yaml.MappingEndEvent):
            if not isinstance(event, yaml.ScalarEvent):
                self._refuse("a key that is not a word", event, keys, "write key: value")
            key = event.value
            if key in values:
                words = f"the key {one_line(repr(key))} stands here twice, first on line {lines[key]}"
                self._refuse(words, event, (*keys, key), "delete or rename one of them")
            lines[key] = event.start_mark.line + 1
            self._note((*keys, key), event)
            values[key] = self._node(next(self.events), (*keys, key))
        return values

    def _anchored(self, event: yaml.AliasEvent, keys: Keys) -> Any:
        if event.anchor in self.open:
            self._refuse("an alias that contains itself", event, keys, "write the value out")
        if event.anchor not in self.anchors:
            cure = "correct its name, or write the value out"
            self._refuse(f"there is no &{event.anchor} above this alias", event, keys, cure)
        return self.anchors[event.anchor]

    def _repeated(self, value: Any, event: yaml.Event, keys: Keys, depth: int = 0) -> Any:
        """A copy, each value of which counts."""
        self._spend(event, keys, depth)
        if isinstance(value, list):
            return [self._repeated(item, event, keys, depth + 1) for item in value]
        if isinstance(value, dict):
            return {key: self._repeated(item, event, keys, depth + 1) for key, item in value.items()}
        return value

    def _spend(self, event: yaml.Event, keys: Keys, deeper: int = 0) -> None:
        self.count += 1
        if self.count > self.limits.values:
            cure = "is it the right file? an alias (*name) repeats all that its anchor (&name) holds"
            self._refuse(f"holds more than {self.limits.values:,} values", event, (), cure)
        if len(keys) + deeper > self.limits.depth:
            words = f"lists and maps are nested more than {self.limits.depth} deep"
            self._refuse(words, event, keys[:4], "is a bracket missing, or an indent too much?")

    def _scalar(self, event: yaml.ScalarEvent, keys: Keys) -> Any:
        text, match, tagged = event.value, _CORE.fullmatch(event.value), event.tag not in (None, "!")
        kind = match.lastgroup if match and event.tag is None and event.implicit[0] else "str"
        if tagged:
            kind = event.tag.removeprefix(_TAG)
            if kind not in ("null", "bool", "int", "float"):
                self._check_tag(event, keys, "str")
            elif match is None or (match.lastgroup != kind and (match.lastgroup, kind) != ("int", "float")):
                self._refuse(
                    f"{one_line(repr(text))} is no {kind}", event, keys, "delete the tag, or correct the value"
                )
        if kind in ("int", "float") and len(text) > self.limits.digits:
            cure = f"write it with {self.limits.digits} at most"
            self._refuse(f"a number of {len(text)} characters", event, keys, cure)
        if kind == "int":
            return int(text, 0) if text[:2] in ("0o", "0x") else int(text)
        if kind == "float":
            return float(text.lower().replace(".inf", "inf").replace(".nan", "nan"))
        return {"null": None, "bool": text.lower() == "true"}.get(kind, text)

    def _check_tag(self, event: yaml.Event, keys: Keys, kind: str) -> None:
        if event.tag not in (None, "!", _TAG + kind):
            self._refuse(f"the tag {one_line(repr(event.tag))} is not known", event, keys, "delete the tag")

    def _refuse(self, words: str, event: yaml.Event, keys: Keys, cure: str) -> NoReturn:
        raise InputError(words, file=f"{self.path}:{event.start_mark.line + 1}", key=key_path(keys), cure=cure)


def key_path(keys: Keys) -> str | None:
    """How errors write the way to a value.

    >>> key_path(("photos", 0, "masks"))
    'photos[0].masks'
    """
    text = "".join(f"[{key}]" if isinstance(key, int) else f".{one_line(key)}" for key in keys)
    return text.removeprefix(".") or None


# ── types ────────────────────────────────────────────────────────────────────────────────────────────────────────────

_MESSAGE = re.compile(r"^(?P<found>.*?)(?: - at `(?P<where>[^`]*)`)?$", re.DOTALL)
_STEP = re.compile(r"\.(?P<name>[^.\[]+)|\[(?P<index>\d+|\.\.\.)\]")
_UNKNOWN = re.compile(r"unknown field `(.*)`", re.DOTALL)
_MISSING = re.compile(r"missing required field `(.*)`", re.DOTALL)


def convert(value: Any, type_: type[T], name: str | Path, prefix: str = "", text: str | None = None) -> T:
    """Plain data, wherever it came from, as a value of a msgspec type; errors as in `read_yaml`.

    name: what errors call the data;  prefix: stands before their keys;  text: what it was read from, for their lines
    """
    try:
        return msgspec.convert(value, type_)
    except msgspec.ValidationError as error:
        words, keys = _place(str(error), value, type_)
    if unknown := _UNKNOWN.search(words):
        fields = [field for info in _types_at(type_, keys) for field in getattr(info, "fields", ())]
        keys, cure = (*keys, unknown[1]), did_you_mean(unknown[1], [field.encode_name for field in fields])
        words = f"unknown key {one_line(repr(unknown[1]))}"
    elif missing := _MISSING.search(words):
        words, cure = f"the key {missing[1]!r} is missing", f"add {missing[1]}: …"
    else:
        given = _at_keys(value, keys)
        choices = [str(word) for info in _types_at(type_, keys) for word in getattr(info, "values", ())]
        quoted = isinstance(given, int | float) and "xpected `str" in words
        words = f"{words[:1].lower()}{words[1:]}" + (
            "" if isinstance(given, dict | list) else f": {one_line(repr(given))}"
        )
        cure = f"one of {', '.join(choices)}" if choices else "write a value of that kind"
        cure = f'put it in quotes: "{one_line(str(given))}"' if quoted else cure
    file = f"{name}:{_line_of(text, keys)}" if text is not None else name
    raise InputError(
        words, file=file, key=".".join(filter(None, (prefix, key_path(keys)))) or None, cure=cure
    ) from None


def _line_of(text: str, keys: Keys) -> int:
    """The line on which the value at `keys` stands, or what of the way to it is there; the text has been read before."""
    document = _Document(text, "", LIMITS, keys)
    try:
        document.value()
    except InputError:
        pass  # as far as it goes
    return document.line


def _place(error: str, value: Any, type_: type) -> tuple[str, Keys]:
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
        try:
            msgspec.convert(_with(value, keys, {key: table[key] for key in half}), type_)
            guilty = False
        except msgspec.ValidationError as other:
            guilty = str(other) == error
        names = half if guilty else names[len(half) :]
    return names[0]


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


def _types_at(type_: type, keys: Keys) -> list[inspect.Type]:
    """What may stand where `keys` lead to, each alternative of a union for itself."""
    here = _alternatives([inspect.type_info(type_)])
    for key in keys:
        here = _alternatives([below for info in here for below in _below(info, key)])
    return here


def _alternatives(infos: list) -> list:
    return [one for info in infos for one in (_alternatives(list(info.types)) if hasattr(info, "types") else [info])]


def _below(info: inspect.Type, key: str | int) -> list:
    if isinstance(info, inspect.StructType):
        return [field.type for field in info.fields if field.encode_name == key]
    if isinstance(info, inspect.TupleType):
        return list(info.item_types[key : key + 1]) if isinstance(key, int) else []
    return [getattr(info, name) for name in ("value_type", "item_type") if hasattr(info, name)]
