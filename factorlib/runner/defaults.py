"""A stage's parameters and their defaults, read from syntax trees: planning must not import what a stage imports.

A default may stand in a base class, or be taken from an instance that a module makes of a class without arguments:

    NOISE = Noise()

    class Params(Bundle, frozen=True):
        noise_absolute: float = NOISE.absolute

As a value, so that a parameter that is set to its default can be distinguished from one that changes something, a default is also
followed to a constant of a module (`CREASE_DEG`) and into a struct of parameters (`Limits()`).
"""

from __future__ import annotations

import ast
from collections import Counter
from collections.abc import Callable
from typing import Any

import msgspec

DEEPEST = 16  # names that stand for names, structs in structs: one more is not followed


class Class(msgspec.Struct, frozen=True):
    """bases: as they are written;  fields: annotated names, with the expressions of their defaults"""

    bases: list[str]
    fields: dict[str, str]


class Names(msgspec.Struct, frozen=True):
    """Of a module.  classes: by name;  imported: the module and the name there, by the name here;  instances: the class, by name;
    constants: the text of what is assigned to a name, of names that are bound once in the whole module"""

    classes: dict[str, Class]
    imported: dict[str, tuple[str, str]]
    instances: dict[str, str]
    constants: dict[str, str] = {}


class Unknown:
    """Stands for a default that no syntax tree tells."""


UNKNOWN = Unknown()


def names_of(tree: ast.Module) -> Names:
    """What the top level of a module defines and takes `from` others."""
    classes, imported, instances, constants = {}, {}, {}, {}
    for node in tree.body:
        if isinstance(node, ast.ClassDef):
            fields = [
                item for item in node.body if isinstance(item, ast.AnnAssign) and isinstance(item.target, ast.Name)
            ]
            defaults = {item.target.id: ast.unparse(item.value) if item.value else "none" for item in fields}
            classes[node.name] = Class([ast.unparse(base) for base in node.bases], defaults)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            imported |= {alias.asname or alias.name: (node.module, alias.name) for alias in node.names}
        elif isinstance(node, ast.Assign):
            for target, value in _pairs(node):
                if isinstance(value, ast.Call) and not value.args and not value.keywords:
                    instances[ast.unparse(target)] = ast.unparse(value.func)
                elif isinstance(target, ast.Name) and isinstance(
                    value, ast.Constant | ast.Tuple | ast.UnaryOp | ast.Name
                ):
                    constants[target.id] = ast.unparse(value)
    bound = Counter(
        node.id for node in ast.walk(tree) if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store | ast.Del)
    )
    return Names(classes, imported, instances, {name: text for name, text in constants.items() if bound[name] == 1})


def _pairs(node: ast.Assign) -> list[tuple[ast.expr, ast.expr]]:
    """A, B = x, y as two assignments."""
    (target, *others), value = node.targets, node.value
    if (
        not others
        and isinstance(target, ast.Tuple)
        and isinstance(value, ast.Tuple)
        and len(target.elts) == len(value.elts)
    ):
        return list(zip(target.elts, value.elts, strict=True))
    return [(each, value) for each in node.targets]


def defaults_of(module: str, name: str, names: Callable[[str], Names | None]) -> dict[str, str]:
    """Fields of the class `name` of `module`, those of its bases first, with their defaults as text; `none` where one has no default.

    names: of a module of the project; None for any other
    """
    here = names(module)
    if here is None:
        return {}
    if name not in here.classes:
        return defaults_of(*here.imported[name], names) if name in here.imported else {}
    found: dict[str, str] = {}
    for base in here.classes[name].bases:
        found |= defaults_of(module, base, names)
    for field, text in here.classes[name].fields.items():
        of, _, attribute = text.partition(".")
        made = defaults_of(module, here.instances[of], names) if of in here.instances else {}
        found[field] = made.get(attribute, text)
    return found


# ── defaults as values ───────────────────────────────────────────────────────────────────────────────────────────────


def values_of(module: str, name: str, names: Callable[[str], Names | None], deep: int = 0) -> dict[str, Any]:
    """Fields of a class as `defaults_of` finds them, each default as a value as YAML would have it: a struct is a table, a tuple a list.

    What is no literal, and leads to none by names, is UNKNOWN.
    """
    here = names(module)
    if here is None or deep > DEEPEST:
        return {}
    if name not in here.classes:
        return values_of(*here.imported[name], names, deep + 1) if name in here.imported else {}
    found: dict[str, Any] = {}
    for base in reversed(here.classes[name].bases):  # the first of two bases decides
        found |= values_of(module, base, names, deep + 1)
    return found | {field: _value(text, module, names, deep) for field, text in here.classes[name].fields.items()}


def _value(text: str, module: str, names: Callable[[str], Names | None], deep: int) -> Any:
    here, (of, _, attribute) = names(module), text.partition(".")
    if here is None or deep > DEEPEST:
        return UNKNOWN
    if text.endswith("()"):
        return values_of(module, text.removesuffix("()"), names, deep + 1) or UNKNOWN
    if text in here.constants:
        return _value(here.constants[text], module, names, deep + 1)
    if text in here.imported:
        source, name = here.imported[text]
        return _value(name, source, names, deep + 1)
    if of in here.instances:
        return values_of(module, here.instances[of], names, deep + 1).get(attribute, UNKNOWN)
    if (
        of in here.imported
        and attribute
        and (there := names(here.imported[of][0]))
        and here.imported[of][1] in there.instances
    ):
        return _value(f"{here.imported[of][1]}.{attribute}", here.imported[of][0], names, deep + 1)
    return _literal(text)


def _literal(text: str) -> Any:
    """
    >>> _literal("1e-3"), _literal("(1, 2.0)"), _literal("none") is UNKNOWN
    (0.001, [1, 2.0], True)
    """
    try:
        return _listed(ast.literal_eval(text))
    except (ValueError, SyntaxError):
        return UNKNOWN


def _listed(value: Any) -> Any:
    return [_listed(item) for item in value] if isinstance(value, tuple | list) else value


def other_than(defaults: dict[str, Any], values: dict[str, Any]) -> dict[str, Any]:
    """The parameters that are not what they would be without being set; of a table those of its fields.

    >>> other_than({"lobes": 72, "gain": 0.5, "limits": {"faces": 9, "size": 2}}, {"lobes": 72, "gain": 0.25, "limits": {"faces": 9}})
    {'gain': 0.25}
    >>> other_than({"lobes": 72, "gain": 1.0}, {"lobes": 72.0, "gain": 1})
    {'lobes': 72.0}
    """
    found = {}
    for name, value in values.items():
        default = defaults.get(name, UNKNOWN)
        if isinstance(value, dict) and isinstance(default, dict):
            value = other_than(default, value)
            if not value:
                continue
        elif _same(value, default):
            continue
        found[name] = value
    return found


def _same(value: Any, default: Any) -> bool:
    """Whether they are one value to a field with that default: a whole number will do for any number, 1 is not true, and -0.0 not 0.0."""
    if isinstance(value, list) and isinstance(default, list):
        return len(value) == len(default) and all(map(_same, value, default))
    if type(default) is float and type(value) is int:
        value = float(value) if abs(value) < 1 << 53 else value
    return type(value) is type(default) and repr(value) == repr(default)
