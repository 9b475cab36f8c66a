"""What a stage's parameters mean, may be, and are by default: read from its `Params`, each field followed by a string that says it.

class Params(msgspec.Struct):
    lobes: Annotated[int, Meta(ge=1)] = 72
    "Most lobes that an illumination may get."
"""

from __future__ import annotations

import ast
import inspect
import textwrap
from typing import Any

import msgspec
from msgspec.inspect import (
    BoolType,
    Field,
    FloatType,
    IntType,
    LiteralType,
    NoneType,
    StrType,
    StructType,
    Type,
    UnionType,
    type_info,
)


class Parameter(msgspec.Struct, frozen=True):
    """name: dotted where it is a field of a field;  allowed: in words, as `1 … 1,024`;  default: as YAML would have it"""

    name: str
    allowed: str
    default: str
    text: str


def parameters(params: type) -> list[Parameter]:
    """Of a stage's `Params`, in its order; a field that is a struct stands for its own fields."""
    info, texts, found = type_info(params), texts_of(params), []
    assert isinstance(info, StructType)
    for field in info.fields:
        if isinstance(field.type, StructType):
            inner = parameters(field.type.cls)
            found += [msgspec.structs.replace(one, name=f"{field.name}.{one.name}") for one in inner]
        else:
            found.append(Parameter(field.name, allowed(field.type), _default(field), texts.get(field.name, "")))
    return found


def texts_of(struct: type) -> dict[str, str]:
    """The strings that follow the fields of a class and of those it is derived from."""
    found: dict[str, str] = {}
    for cls in reversed(struct.__mro__):
        if not issubclass(cls, msgspec.Struct) or cls is msgspec.Struct:
            continue
        body = ast.parse(textwrap.dedent(inspect.getsource(cls))).body[0].body
        for field, text in zip(body, body[1:], strict=False):
            if isinstance(field, ast.AnnAssign) and isinstance(text, ast.Expr) and isinstance(text.value, ast.Constant):
                found[field.target.id] = " ".join(str(text.value.value).split())
    return found


def _default(field: Field) -> str:
    value = (
        field.default_factory()
        if field.default is msgspec.NODEFAULT and callable(field.default_factory)
        else field.default
    )
    return "none" if value is msgspec.NODEFAULT else msgspec.json.encode(value).decode().replace(",", ", ")


def allowed(of: Type) -> str:
    """What a value may be.

    >>> allowed(type_info(int)), allowed(IntType(ge=1, le=1024)), allowed(FloatType(gt=0)), allowed(type_info(bool))
    ('whole number', '1 … 1,024', 'number > 0', 'true, false')
    """
    if isinstance(of, IntType | FloatType):
        return _range(of)
    if isinstance(of, LiteralType):
        return ", ".join(str(value) for value in sorted(of.values, key=str))
    if isinstance(of, UnionType):
        return " or ".join(allowed(each) for each in of.types)
    if items := getattr(of, "item_types", None):
        return f"{len(items)} of: {allowed(items[0])}"
    words: dict[type, str] = {BoolType: "true, false", StrType: "text", NoneType: "null"}
    return words.get(type(of), type(of).__name__)


def _range(of: Any) -> str:
    word = "whole number" if isinstance(of, IntType) else "number"
    if of.ge is not None and of.le is not None:
        return f"{of.ge:,} … {of.le:,}"
    bounds = ((">", of.gt), ("≥", of.ge), ("<", of.lt), ("≤", of.le))
    said = " and ".join(f"{sign} {bound:,}" for sign, bound in bounds if bound is not None)
    return f"{word} {said}".strip()
