"""YAML files as typed structs: scalars as in YAML 1.2, no key twice or unknown, every complaint with file, line and key.

PyYAML reads `1e-3` as a string and `no` as False, and lets a duplicate key win silently, so only its events are used.  What is
nested without end, grows without end through aliases, or is merely huge is refused when it passes a limit, not when memory or
the stack is full.  msgspec converts the value to its type, whose `Meta` says what a number or a name may be and how to mend it.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, NoReturn, TypeVar, Union, get_args, get_origin

import msgspec
import yaml

from factorlib.errors import InputError, did_you_mean, raise_all
from factorlib.reading import one_line, read_text

T = TypeVar("T")
Keys = tuple[str | int, ...]  # the way to a value: mapping keys and list indices from the root
_CORE = re.compile(  # YAML 1.2.2, section 10.3.2
    r"(?P<null>~|null|Null|NULL|)|(?P<bool>true|True|TRUE|false|False|FALSE)|(?P<int>[-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+)"
    r"|(?P<float>[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN))"
)
_Parser = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_FIELD = re.compile(r"(?P<fault>unknown|missing required) field `(?P<name>.*)`", re.DOTALL)


# The most that a file may hold, far above a dataset of ten thousand photos: values are scalars, lists and maps, those that
# aliases repeat counted each time; the depth is that of lists and maps in each other; digits are those of a number.
MOST_BYTES, MOST_VALUES, MOST_DEPTH, MOST_DIGITS = 64_000_000, 2_000_000, 64, 300


def read_yaml(path: str | Path, type_: type[T], most_values: int = MOST_VALUES) -> T:
    """Read the file as a value of a msgspec type; InputError with file, line, key and cure for whatever does not fit."""
    text = read_text(path, "a YAML file", most_bytes=MOST_BYTES)
    return convert(parse_yaml(text, path, most_values), type_, path, text=text)


def load_yaml(path: str | Path) -> Any:
    """Read the file as dicts, lists and scalars; InputError with file, line, key and cure for what is not YAML."""
    return parse_yaml(read_text(path, "a YAML file", most_bytes=MOST_BYTES), path)


def parse_yaml(text: str, name: str | Path = "", most_values: int = MOST_VALUES) -> Any:
    """Parse the text's one document as dicts, lists and scalars; InputError names line, key and `name`, which errors call the text.

    >>> parse_yaml("{a: 1e-3, b: no, c: [1, ~, true]}")
    {'a': 0.001, 'b': 'no', 'c': [1, None, True]}
    """
    return _Document(text, name, most_values).value()


class _Document:
    """One pass over the events of a text, which builds its value and counts it."""

    def __init__(self, text: str, name: str | Path, most_values: int):
        self.text, self.name, self.most_values, self.events = text, name, most_values, self._events()
        self.count, self.anchors, self.unfinished = 0, {}, set()

    def value(self) -> Any:
        """Return the value of the one document in the text, None for an empty text.  InputError where there is a second."""
        next(self.events)  # the stream
        if isinstance(next(self.events), yaml.StreamEndEvent):
            return None
        value = self._node(next(self.events), ())
        next(self.events)  # the document's end
        if not isinstance(after := next(self.events), yaml.StreamEndEvent):
            self._refuse("there is a second document", after, (), "delete it, and the --- before it")
        return value

    def _events(self) -> Iterator[yaml.Event]:
        try:
            yield from yaml.parse(self.text, Loader=_Parser)
        except yaml.YAMLError as error:
            mark, context = getattr(error, "problem_mark", None), getattr(error, "context", None)
            words = [one_line(part) for part in (getattr(error, "problem", None) or str(error), context) if part]
            cure = "look for a bracket, quote, colon or indent on or above this line"
            file = f"{self.name}:{mark.line + 1}" if mark else self.name
            raise InputError(f"not YAML: {' '.join(words)}", file=file, cure=cure) from error

    def _node(self, event: yaml.Event, keys: Keys) -> Any:
        if isinstance(event, yaml.AliasEvent):
            if event.anchor in self.unfinished:
                self._refuse("an alias that contains itself", event, keys, "write the value out")
            if event.anchor not in self.anchors:
                cure = "correct its name, or write the value out"
                self._refuse(f"there is no &{event.anchor} above this alias", event, keys, cure)
            return self._copy(self.anchors[event.anchor], event, keys, 0)
        self._count(event, keys, 0)
        if event.tag not in (None, "!"):
            self._refuse(f"the tag {one_line(repr(event.tag))} is not known", event, keys, "delete the tag")
        self.unfinished.add(event.anchor)
        if isinstance(event, yaml.ScalarEvent):
            value = self._scalar(event, keys)
        elif isinstance(event, yaml.SequenceStartEvent):
            value = []
            while not isinstance(item := next(self.events), yaml.SequenceEndEvent):
                value.append(self._node(item, (*keys, len(value))))
        else:
            value = self._map(keys)
        self.unfinished.discard(event.anchor)
        self.anchors[event.anchor] = value
        return value

    def _map(self, keys: Keys) -> dict[str, Any]:
        values, lines = {}, {}
        while not isinstance(event := next(self.events), yaml.MappingEndEvent):
            if not isinstance(event, yaml.ScalarEvent):
                self._refuse("a key that is not a word", event, keys, "write key: value")
            key = event.value
            if key in values:
                fault = f"the key {one_line(repr(key))} stands here twice, first on line {lines[key]}"
                self._refuse(fault, event, (*keys, key), "delete or rename one of them")
            lines[key] = event.start_mark.line + 1
            values[key] = self._node(next(self.events), (*keys, key))
        return values

    def _copy(self, value: Any, event: yaml.Event, keys: Keys, depth: int) -> Any:
        """Copy what an alias repeats, each value of which counts."""
        self._count(event, keys, depth)
        if isinstance(value, list):
            return [self._copy(item, event, keys, depth + 1) for item in value]
        if isinstance(value, dict):
            return {key: self._copy(item, event, keys, depth + 1) for key, item in value.items()}
        return value

    def _count(self, event: yaml.Event, keys: Keys, deeper: int) -> None:
        self.count += 1
        if self.count > self.most_values:
            cure = "is it the right file? an alias (*name) repeats all that its anchor (&name) holds"
            self._refuse(f"holds more than {self.most_values:,} values", event, (), cure)
        if len(keys) + deeper > MOST_DEPTH:
            fault = f"lists and maps are nested more than {MOST_DEPTH} deep"
            self._refuse(fault, event, keys[:4], "is a bracket missing, or an indent too much?")

    def _scalar(self, event: yaml.ScalarEvent, keys: Keys) -> Any:
        text, match = event.value, _CORE.fullmatch(event.value)
        kind = match.lastgroup if match and event.tag is None and event.implicit[0] else "str"
        if kind in ("int", "float") and len(text) > MOST_DIGITS:
            cure = f"write it with {MOST_DIGITS} at most"
            self._refuse(f"a number of {len(text)} characters", event, keys, cure)
        if kind == "int":
            return int(text, 0) if text[:2] in ("0o", "0x") else int(text)
        if kind == "float":
            return float(text.lower().replace(".inf", "inf").replace(".nan", "nan"))
        return {"null": None, "bool": text.lower() == "true"}.get(kind, text)

    def _refuse(self, fault: str, event: yaml.Event, keys: Keys, cure: str) -> NoReturn:
        raise InputError(fault, file=f"{self.name}:{event.start_mark.line + 1}", key=key_path(keys), cure=cure)


def key_path(keys: Keys) -> str | None:
    """Format the way to a value as errors write it.

    >>> key_path(("photos", 0, "masks"))
    'photos[0].masks'
    """
    text = "".join(f"[{key}]" if isinstance(key, int) else f".{one_line(key)}" for key in keys)
    return text.removeprefix(".") or None


def convert(value: Any, type_: type[T], name: str | Path, prefix: str = "", text: str | None = None) -> T:
    """Convert plain data, wherever it came from, to a value of a msgspec type; errors as in `read_yaml`.

    The cure is the `description` of the field's `Meta`, where it has one.
    name: what errors call the data;  prefix: stands before their keys;  text: what it was read from, for their lines
    """
    try:
        return msgspec.convert(value, type_)
    except msgspec.ValidationError as error:
        innermost = _innermost(error, value, type_)
    root = yaml.compose(text, Loader=_Parser) if text is not None else None
    raise_all([_fault(*fault, name, prefix, root) for fault in innermost])


def _fault(words: str, value: Any, types: list, keys: Keys, name: str | Path, prefix: str, root: Any) -> InputError:
    """Describe what msgspec says of a value, with its key and a cure."""
    if field := _FIELD.search(words):
        words, cure = f"the key {field['name']!r} is missing", f"add {field['name']}: …"
        if field["fault"] == "unknown":
            known = [f.encode_name for each in types if _is_struct(each) for f in msgspec.structs.fields(each)]
            words, cure = f"unknown key {one_line(repr(field['name']))}", did_you_mean(field["name"], known)
            keys = (*keys, field["name"])
    else:
        choices = [str(word) for each in types if get_origin(each) is Literal for word in get_args(each)]
        described = [meta.description for each in types for meta in getattr(each, "__metadata__", ())]
        one_of = f"one of {', '.join(choices)}" if choices else "write a value of that kind"
        cure = next(filter(None, described), one_of)
        if isinstance(value, int | float) and "xpected `str" in words:
            cure = f'put it in quotes: "{one_line(str(value))}"'
        words = f"{words[:1].lower()}{words[1:]}"
        words += "" if isinstance(value, dict | list) else f": {one_line(repr(value))}"
    file = name if root is None else f"{name}:{_line_of(root, keys)}"
    key = ".".join(filter(None, (prefix, key_path(keys)))) or None
    return InputError(words, file=file, key=key, cure=cure)


def _innermost(
    error: msgspec.ValidationError, value: Any, type_: Any, keys: Keys = ()
) -> list[tuple[str, Any, list, Keys]]:
    """List each innermost value at fault: the fault's words, the value, the types that it may have, and the way to it."""
    types = [type_]
    for each in types:  # and, where one is a union or described by a `Meta`, all that it stands for
        types += get_args(each) if get_origin(each) in (Union, UnionType) else ()
        types += get_args(each)[:1] if get_origin(each) is Annotated else ()
    found = []
    for key, item, inner in (child for each in types for child in _children(value, each)):
        try:
            msgspec.convert(item, inner)
        except msgspec.ValidationError as below:
            found += _innermost(below, item, inner, (*keys, key))
    return found or [(str(error), value, types, keys)]


def _children(value: Any, type_: Any) -> Iterator[tuple[str | int, Any, Any]]:
    """Key, value and type of what a list or map holds, and of a map's own keys."""
    args, origin = get_args(type_), get_origin(type_)
    if isinstance(value, dict) and origin is dict:
        yield from ((key, key, args[0]) for key in value)
        yield from ((key, item, args[1]) for key, item in value.items())
    elif isinstance(value, dict) and _is_struct(type_):
        fields = msgspec.structs.fields(type_)
        yield from ((f.encode_name, value[f.encode_name], f.type) for f in fields if f.encode_name in value)
    elif isinstance(value, list) and origin in (list, tuple):
        same = origin is list or args[-1:] == (...,)
        yield from zip(range(len(value)), value, args[:1] * len(value) if same else args)


def _is_struct(type_: Any) -> bool:
    return isinstance(type_, type) and issubclass(type_, msgspec.Struct)


def _line_of(node: yaml.Node | None, keys: Keys) -> int:
    """Return the line on which the value at `keys` of a document stands, or what of the way to it is there."""
    line = node.start_mark.line if node else 0
    for key in keys:
        if isinstance(node, yaml.MappingNode):
            word, node = next((pair for pair in node.value if pair[0].value == key), (None, None))
            line = word.start_mark.line if word else line
        elif isinstance(node, yaml.SequenceNode):
            node = node.value[key]
            line = node.start_mark.line
    return line + 1


class _Dumper(yaml.SafeDumper):
    """Maps as blocks, other lists on one line; words plain, other text in quotes, for YAML 1.2 has other numbers than PyYAML."""

    def increase_indent(self, flow: bool = False, indentless: bool = False) -> None:
        super().increase_indent(flow, False)

    def represent_str(self, text: str) -> yaml.Node:
        plain = re.fullmatch(r"[A-Za-z_][A-Za-z0-9_./-]*", text)
        return self.represent_scalar("tag:yaml.org,2002:str", text, style=None if plain else '"')

    def represent_list(self, items: list) -> yaml.Node:
        flow = not any(isinstance(item, dict) for item in items)
        return self.represent_sequence("tag:yaml.org,2002:seq", items, flow_style=flow)


_Dumper.add_representer(str, _Dumper.represent_str)
_Dumper.add_representer(list, _Dumper.represent_list)


def yaml_text(value: Any) -> str:
    """Dicts, lists and scalars as YAML that `parse_yaml` reads.

    >>> print(yaml_text({"a": [1, 0.5], "b": [{"c": "x", "d": {"e": "1"}}]}), end="")
    a: [1, 0.5]
    b:
      - c: x
        d:
          e: "1"
    """
    return yaml.dump(value, Dumper=_Dumper, sort_keys=False, allow_unicode=True, default_flow_style=False, width=10**6)


def with_value(text: str, keys: Keys, word: str) -> str:
    """Replace the value at `keys`, which is there, by `word` as it is written; every other character stays."""
    node = yaml.compose(text, Loader=yaml.SafeLoader)
    for key in keys:
        node = node.value[key] if isinstance(key, int) else next(item for name, item in node.value if name.value == key)
    return text[: node.start_mark.index] + word + text[node.end_mark.index :]
