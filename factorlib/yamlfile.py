"""YAML files as typed structs: scalars as in YAML 1.2, no duplicate or unknown key, errors with file, line and key.

PyYAML reads `1e-3` as a string and `no` as False, and silently accepts a duplicate key, so only its nodes are used.
Nesting, growth through aliases and size have limits, so that an error comes before memory or the stack is full.
msgspec converts the value to its type, whose `Meta` states the valid numbers or names and the cure for others.
"""

import re
from collections.abc import Iterator
from itertools import count
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, NoReturn, TypeVar, Union, get_args, get_origin

import msgspec
import yaml

from factorlib.errors import InputError, did_you_mean, raise_all
from factorlib.reading import one_line, read_text

T = TypeVar("T")
Keys = tuple[str | int, ...]  # path to a value: mapping keys and list indices from the root
Invalid = tuple[str, Any, list, Keys]  # msgspec's message, the invalid value, its possible types and the path to it
# limits of a file, far above a dataset of ten thousand photos
MOST_BYTES = 64_000_000
MOST_VALUES = 2_000_000  # scalars, lists and maps; those that aliases repeat count each time
MOST_DEPTH = 64  # nesting of lists and maps
TOO_DEEP = "look for a missing bracket, a wrong indent, or an alias (*name) inside its anchor (&name)"
_CORE = re.compile(  # YAML 1.2.2, section 10.3.2; a number of more digits is a float or a word
    r"(?P<null>~|null|Null|NULL|)|(?P<bool>true|True|TRUE|false|False|FALSE)"
    r"|(?P<int>[-+]?[0-9]{1,18}|0o[0-7]{1,20}|0x[0-9a-fA-F]{1,15})"
    r"|(?P<float>[-+]?(?:\.[0-9]{1,300}|[0-9]{1,300}(?:\.[0-9]{0,300})?)(?:[eE][-+]?[0-9]{1,300})?"
    r"|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN))"
)
_NOUNS = {
    int: "a whole number",
    float: "a number",
    bool: "true or false",
    str: "text",
    type(None): "null",
    list: "a list",
    tuple: "a list",
    dict: "a map, key: value",
}
_LIMITS = {"ge": "at least", "gt": "more than", "le": "at most", "lt": "less than"}
_FIELD = re.compile(r"(?P<fault>unknown|missing required) field `(?P<name>.*)`", re.DOTALL)


class _Loader(getattr(yaml, "CBaseLoader", yaml.BaseLoader)):  # type: ignore[misc]
    """PyYAML's parser without its own types: the tag of a node is empty unless the file writes one."""

    def resolve(self, kind: type, value: Any, implicit: Any) -> str:
        """Return the tag of a node without one."""
        return ""


def read_yaml(path: str | Path, type_: type[T], most_values: int = MOST_VALUES) -> T:
    """Read a file as a value of a msgspec type.

    Args:
        path: the file
        type_: the type
        most_values: largest number of values

    Raises:
        InputError: Something does not fit; the error names file, line, key and cure.
    """
    text = read_text(path, "a YAML file", most_bytes=MOST_BYTES)
    return convert(parse_yaml(text, path, most_values), type_, path, text=text)


def load_yaml(path: str | Path) -> Any:
    """Read a file as dicts, lists and scalars; InputError names file, line, key and cure if it is not YAML."""
    return parse_yaml(read_text(path, "a YAML file", most_bytes=MOST_BYTES), path)


def parse_yaml(text: str, name: str | Path = "", most_values: int = MOST_VALUES) -> Any:
    """Parse the text's one document to dicts, lists and scalars.

    Args:
        text: the text
        name: the name of the text in errors
        most_values: largest number of values

    Raises:
        InputError: The text is not YAML; the error names line and key.

    >>> parse_yaml("{a: 1e-3, b: no, c: [1, ~, true]}")
    {'a': 0.001, 'b': 'no', 'c': [1, None, True]}
    """
    return _parse(text, name, most_values)[0]


def _compose(text: str, name: str | Path) -> yaml.Node | None:
    """Return the root node of the text's one document, None for an empty text; InputError if it is not YAML."""
    try:
        depth = 0
        for event in yaml.parse(text, Loader=_Loader):  # first: composing is recursive, and would overflow the stack
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            if depth > MOST_DEPTH:
                fault = f"lists and maps are nested more than {MOST_DEPTH} deep"
                raise InputError(fault, file=f"{name}:{event.start_mark.line + 1}", cure=TOO_DEEP)
        return yaml.compose(text, Loader=_Loader)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        words = [getattr(error, part, None) for part in ("context", "problem")]
        fault = ": ".join(one_line(part) for part in words if part) or one_line(str(error))
        raise InputError(
            f"not YAML: {fault}",
            file=f"{name}:{mark.line + 1}" if mark else name,
            cure="look on or above this line for a bracket, quote, colon, indent, or alias (*name) without anchor",
        ) from error


def _parse(text: str, name: str | Path, most_values: int) -> tuple[Any, dict[Keys, int]]:
    """Convert the text's one document to dicts, lists and scalars; return the line of each value, too, by its path.

    InputError is raised for duplicate keys, tags, and what exceeds the limits.
    """
    number = count(1)
    lines: dict[Keys, int] = {}

    def refuse(fault: str, node: yaml.Node, keys: Keys, cure: str) -> NoReturn:
        """Raise InputError for a node."""
        raise InputError(fault, file=f"{name}:{node.start_mark.line + 1}", key=key_path(keys), cure=cure)

    def plain(node: yaml.Node, keys: Keys) -> Any:
        """Convert a node, and record the lines of what it holds."""
        if next(number) > most_values:
            refuse(
                f"holds more than {most_values:,} values",
                node,
                (),
                "check that it is the right file: an alias (*name) repeats all that its anchor (&name) holds",
            )
        if len(keys) > MOST_DEPTH:
            refuse(f"lists and maps are nested more than {MOST_DEPTH} deep", node, keys[:4], TOO_DEEP)
        if node.tag:
            refuse(f"the tag {one_line(repr(node.tag))} is not known", node, keys, "delete the tag")
        lines.setdefault(keys, node.start_mark.line + 1)
        if isinstance(node, yaml.ScalarNode):
            return node.value if node.style else _scalar(node.value)
        if isinstance(node, yaml.SequenceNode):
            return [plain(item, (*keys, index)) for index, item in enumerate(node.value)]
        values: dict[str, Any] = {}
        for word, item in node.value:
            if not isinstance(word, yaml.ScalarNode):
                refuse("a key is a list or a map, not a word", word, keys, "write key: value")
            below = (*keys, word.value)
            if word.value in values:
                fault = f"the key {one_line(repr(word.value))} occurs twice, first on line {lines[below]}"
                refuse(fault, word, below, "delete or rename one of them")
            lines[below] = word.start_mark.line + 1
            values[word.value] = plain(item, below)
        return values

    root = _compose(text, name)
    return (None, {(): 1}) if root is None else (plain(root, ()), lines)


def _scalar(text: str) -> Any:
    """Return the value of a scalar without quotes."""
    match = _CORE.fullmatch(text)
    kind = match.lastgroup if match else "str"
    if kind == "int":
        return int(text, 0) if text[:2] in ("0o", "0x") else int(text)
    if kind == "float":
        return float(text.lower().replace(".inf", "inf").replace(".nan", "nan"))
    if kind == "bool":
        return text.lower() == "true"
    return None if kind == "null" else text


def key_path(keys: Keys) -> str | None:
    """Return the path to a value as errors write it.

    >>> key_path(("photos", 0, "masks"))
    'photos[0].masks'
    """
    text = "".join(f"[{key}]" if isinstance(key, int) else f".{one_line(key)}" for key in keys)
    return text.removeprefix(".") or None


def convert(value: Any, type_: type[T], name: str | Path, prefix: str = "", text: str | None = None) -> T:
    """Convert plain data to a value of a msgspec type.

    The cure of an error is the `description` of the field's `Meta`, if it has one.

    Args:
        value: the data
        type_: the type
        name: the name of the data in errors
        prefix: the prefix of keys in errors
        text: the YAML text of the data, for line numbers in errors

    Raises:
        InputError: Something does not fit, as for `read_yaml`.
    """
    try:
        return msgspec.convert(value, type_)
    except msgspec.ValidationError as error:
        invalid = _innermost(error, value, type_)
    lines = _parse(text, name, MOST_VALUES)[1] if text is not None else {}
    faults = []
    for each in invalid:
        fault, cure, keys = _describe(each)
        # line of the value, or of the last existing part of its path
        line = next((lines[keys[:k]] for k in range(len(keys), -1, -1) if keys[:k] in lines), None)
        key = ".".join(filter(None, (prefix, key_path(keys)))) or None
        faults.append(InputError(fault, file=f"{name}:{line}" if line else name, key=key, cure=cure))
    raise_all(faults)
    raise AssertionError("a validation error has a fault")


def _describe(invalid: Invalid) -> tuple[str, str, Keys]:
    """Return the fault and the cure of an invalid value, and the path to the faulty key."""
    message, value, types, keys = invalid
    if field := _FIELD.search(message):
        name = field["name"]
        if field["fault"] != "unknown":
            return f"the key {name!r} is missing", f"add {name}: …", keys
        known = [f.encode_name for each in types if _is_struct(each) for f in msgspec.structs.fields(each)]
        return f"unknown key {one_line(repr(name))}", did_you_mean(name, known), (*keys, name)
    described = [meta.description for each in types for meta in getattr(each, "__metadata__", ())]
    cure = next(filter(None, described), None) or _expectation(types)
    if isinstance(value, int | float) and "xpected `str" in message:
        cure = f'put it in quotes: "{one_line(str(value))}"'
    ending = "" if isinstance(value, dict | list) else f": {one_line(repr(value))}"
    return f"{message[:1].lower()}{message[1:]}{ending}", cure, keys


def _expectation(types: list) -> str:
    """Return the cure for a value that is of none of the types: what to write.

    >>> _expectation([Annotated[int, msgspec.Meta(ge=12)], int]), _expectation([Literal["auto", "off"]])
    ('write a whole number of at least 12', 'write one of auto, off')
    """
    choices = [str(word) for each in types if get_origin(each) is Literal for word in get_args(each)]
    nouns: dict[str, str] = {}  # with the limits of each; an `Annotated` type stands before its own type
    for each in types:
        kind, *metas = get_args(each) if get_origin(each) is Annotated else (each,)
        limits = [(word, getattr(meta, name, None)) for meta in metas for name, word in _LIMITS.items()]
        noun = _NOUNS.get(dict if _is_struct(kind) else get_origin(kind) or kind)
        if get_origin(kind) is tuple and get_args(kind)[-1:] != (...,):
            noun = f"a list of {len(get_args(kind))} values"
        if noun:
            nouns.setdefault(noun, " and ".join(f"{word} {limit:.10g}" for word, limit in limits if limit is not None))
    words = [f"{noun} of {limits}" if limits else noun for noun, limits in nouns.items()]
    words += [f"one of {', '.join(choices)}" if len(choices) > 1 else choices[0]] if choices else []
    return f"write {' or '.join(words) or 'another value'}"


def _innermost(error: msgspec.ValidationError, value: Any, type_: Any, keys: Keys = ()) -> list[Invalid]:
    """Return each innermost invalid value."""
    types = [type_]
    for each in types:  # grows by the members of unions and the types inside `Annotated`
        types += get_args(each) if get_origin(each) in (Union, UnionType) else ()
        types += get_args(each)[:1] if get_origin(each) is Annotated else ()
    inside = []
    for key, item, inner in (child for each in types for child in _children(value, each)):
        try:
            msgspec.convert(item, inner)
        except msgspec.ValidationError as below:
            inside += _innermost(below, item, inner, (*keys, key))
    return inside or [(str(error), value, types, keys)]


def _children(value: Any, type_: Any) -> Iterator[tuple[str | int, Any, Any]]:
    """Yield key, value and type of the items of a list or map, and of a map's own keys."""
    args = get_args(type_)
    origin = get_origin(type_)
    if isinstance(value, dict) and origin is dict:
        yield from ((key, key, args[0]) for key in value)
        yield from ((key, item, args[1]) for key, item in value.items())
    elif isinstance(value, dict) and _is_struct(type_):
        fields = msgspec.structs.fields(type_)
        yield from ((f.encode_name, value[f.encode_name], f.type) for f in fields if f.encode_name in value)
    elif isinstance(value, list) and origin in (list, tuple):
        is_homogeneous = origin is list or args[-1:] == (...,)
        yield from zip(range(len(value)), value, args[:1] * len(value) if is_homogeneous else args)


def _is_struct(type_: Any) -> bool:
    return isinstance(type_, type) and issubclass(type_, msgspec.Struct)


class _Dumper(yaml.SafeDumper):
    """Dumper with maps as blocks and other lists on one line.

    Words are plain and other text is quoted, because YAML 1.2 has other numbers than PyYAML.
    """

    def increase_indent(self, flow: bool = False, indentless: bool = False) -> None:
        """Indent lists inside maps."""
        super().increase_indent(flow, False)

    def represent_str(self, text: str) -> yaml.Node:
        """Represent a word plain, other text in double quotes."""
        plain = re.fullmatch(r"[A-Za-z_][A-Za-z0-9_./-]*", text)
        return self.represent_scalar("tag:yaml.org,2002:str", text, style=None if plain else '"')

    def represent_list(self, items: list) -> yaml.Node:
        """Represent a list without maps on one line."""
        flow = not any(isinstance(item, dict) for item in items)
        return self.represent_sequence("tag:yaml.org,2002:seq", items, flow_style=flow)


_Dumper.add_representer(str, _Dumper.represent_str)
_Dumper.add_representer(list, _Dumper.represent_list)


def yaml_text(value: Any) -> str:
    """Return dicts, lists and scalars as YAML that `parse_yaml` reads.

    >>> print(yaml_text({"a": [1, 0.5], "b": [{"c": "x", "d": {"e": "1"}}]}), end="")
    a: [1, 0.5]
    b:
      - c: x
        d:
          e: "1"
    """
    return yaml.dump(value, Dumper=_Dumper, sort_keys=False, allow_unicode=True, default_flow_style=False, width=10**6)
