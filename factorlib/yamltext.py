"""YAML text to plain values: scalars as in YAML 1.2's core schema, no key twice, and never more than `Limits` allow.

The value is built from the parser's events as they come, so that what is nested without end, grows without end through
aliases, or is merely huge is refused when it passes a limit, not when memory or the stack is full.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NoReturn

import msgspec
import yaml

from factorlib.errors import InputError
from factorlib.reading import one_line

Keys = tuple[str | int, ...]  # the way to a value: mapping keys and list indices from the root

_TAG = "tag:yaml.org,2002:"
_CORE = re.compile(  # YAML 1.2.2, section 10.3.2
    r"(?P<null>~|null|Null|NULL|)|(?P<bool>true|True|TRUE|false|False|FALSE)|(?P<int>[-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+)"
    r"|(?P<float>[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN))"
)
_Parser = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class Limits(msgspec.Struct, frozen=True):
    """What a file may hold: far above a dataset of ten thousand photos.

    megabytes of text;  values: scalars, lists and maps, those that aliases repeat counted each time;  depth of lists and
    maps in each other;  digits of a number
    """

    megabytes: float = 64.0
    values: int = 2_000_000
    depth: int = 64
    digits: int = 300


LIMITS = Limits()


def plain_value(text: str, path: str | Path, limits: Limits = LIMITS) -> Any:
    """The text's one document as dicts, lists and scalars; InputError names `path`, line and key."""
    return _Document(text, path, limits, None).value()


def line_of(text: str, keys: Keys) -> int | None:
    """The line on which the value at `keys` stands, or what of the way to it is there; the text has been read before."""
    document = _Document(text, "", LIMITS, keys)
    try:
        document.value()
    except InputError:
        pass  # as far as it goes
    return document.line


class _Document:
    """One pass over the events of a text.  sought: keys whose line is looked for."""

    def __init__(self, text: str, path: str | Path, limits: Limits, sought: Keys | None):
        self.path, self.limits, self.sought = path, limits, sought
        self.line, self._met = None, -1
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
            raise _syntax_error(error, self.path) from error

    def value(self) -> Any:
        """The value of the one document in the text, None for an empty text.  InputError where there is a second."""
        next(self.events)  # the stream
        if isinstance(next(self.events), yaml.StreamEndEvent):
            return None
        value = self._node(next(self.events), ())
        next(self.events)  # the document's end
        after = next(self.events)
        if not isinstance(after, yaml.StreamEndEvent):
            self._refuse("there is a second document", after, (), "delete it, and the --- before it")
        return value

    def _node(self, event: yaml.Event, keys: Keys) -> Any:
        self._note(keys, event)
        if isinstance(event, yaml.AliasEvent):
            return self._repeated(self._anchored(event, keys), event, keys)
        self._spend(event, keys)
        if event.anchor is not None:
            self.open.add(event.anchor)
        if isinstance(event, yaml.ScalarEvent):
            value = self._scalar(event, keys)
        else:
            value = (self._list if isinstance(event, yaml.SequenceStartEvent) else self._map)(event, keys)
        if event.anchor is not None:
            self.open.discard(event.anchor)
            self.anchors[event.anchor] = value
        return value

    def _list(self, start: yaml.SequenceStartEvent, keys: Keys) -> list:
        self._check_tag(start, keys, "seq")
        values: list = []
        while not isinstance(event := next(self.events), yaml.SequenceEndEvent):
            values.append(self._node(event, (*keys, len(values))))
        return values

    def _map(self, start: yaml.MappingStartEvent, keys: Keys) -> dict[str, Any]:
        self._check_tag(start, keys, "map")
        values: dict[str, Any] = {}
        lines: dict[str, int] = {}
        while not isinstance(event := next(self.events), yaml.MappingEndEvent):
            if not isinstance(event, yaml.ScalarEvent):
                self._refuse("a key that is not a word", event, keys, "write key: value")
            key = event.value
            if key in values:
                found = f"the key {one_line(repr(key))} stands here twice, first on line {lines[key]}"
                self._refuse(found, event, (*keys, key), "delete or rename one of them")
            lines[key] = event.start_mark.line + 1
            self._note((*keys, key), event)
            values[key] = self._node(next(self.events), (*keys, key))
        return values

    def _anchored(self, event: yaml.AliasEvent, keys: Keys) -> Any:
        if event.anchor in self.open:
            self._refuse("an alias that contains itself", event, keys, "write the value out")
        if event.anchor not in self.anchors:
            self._refuse(f"there is no &{event.anchor} above this alias", event, keys, "correct its name, or write the value out")
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
            self._refuse(f"lists and maps are nested more than {self.limits.depth} deep", event, keys[:4], "is a bracket missing, or an indent too much?")

    def _note(self, keys: Keys, event: yaml.Event) -> None:
        """Of the values on the way to what is sought, the line of the deepest; a key's goes before its value's."""
        if self.sought is not None and len(keys) > self._met and self.sought[: len(keys)] == keys:
            self.line, self._met = event.start_mark.line + 1, len(keys)

    def _scalar(self, event: yaml.ScalarEvent, keys: Keys) -> Any:
        text, match = event.value, None
        if event.tag in (None, "!"):
            match = _CORE.fullmatch(text) if event.implicit[0] else None
            kind = match.lastgroup if match else "str"
        else:
            kind = event.tag.removeprefix(_TAG)
            match = _CORE.fullmatch(text)
            if kind not in ("str", "null", "bool", "int", "float"):
                self._check_tag(event, keys, "str")
            if kind != "str" and (match is None or match.lastgroup not in (kind, "int" if kind == "float" else kind)):
                self._refuse(f"{one_line(repr(text))} is no {kind}", event, keys, "delete the tag, or correct the value")
        if kind in ("int", "float") and len(text) > self.limits.digits:
            self._refuse(f"a number of {len(text)} characters", event, keys, f"write it with {self.limits.digits} at most")
        return text if kind == "str" else _number(text, kind)

    def _check_tag(self, event: yaml.Event, keys: Keys, kind: str) -> None:
        if event.tag not in (None, "!", _TAG + kind):
            self._refuse(f"the tag {one_line(repr(event.tag))} is not known", event, keys, "delete the tag")

    def _refuse(self, found: str, event: yaml.Event, keys: Keys, cure: str) -> NoReturn:
        raise InputError(found, file=at_line(self.path, event.start_mark.line + 1), key=key_path(keys), cure=cure)


def _number(text: str, kind: str) -> Any:
    if kind == "null":
        return None
    if kind == "bool":
        return text.lower() == "true"
    if kind == "int":
        return int(text, 0) if text[:2] in ("0o", "0x") else int(text)
    return float(text.lower().replace(".inf", "inf").replace(".nan", "nan"))


def _syntax_error(error: yaml.YAMLError, path: str | Path) -> InputError:
    mark, problem = getattr(error, "problem_mark", None), getattr(error, "problem", None) or str(error)
    context = getattr(error, "context", None)
    found = f"not YAML: {one_line(problem)}" + (f" {one_line(context)}" if context else "")
    cure = "look for a bracket, quote, colon or indent on or above this line"
    return InputError(found, file=at_line(path, mark.line + 1 if mark else None), cure=cure)


def key_path(keys: Keys) -> str | None:
    """How errors write the way to a value.

    >>> key_path(("photos", 0, "masks"))
    'photos[0].masks'
    """
    text = "".join(f"[{key}]" if isinstance(key, int) else f".{one_line(key)}" for key in keys)
    return text.removeprefix(".") or None


def at_line(path: str | Path, line: int | None) -> str:
    """`path:line`, the form in which editors find a place; the path alone where the line is not known."""
    return f"{path}:{line}" if line else str(path)
