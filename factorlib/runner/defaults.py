"""A stage's parameters and their defaults, read from syntax trees: planning must not import what a stage imports.

A default may stand in a base class, or be taken from an instance that a module makes of a class without arguments:

    NOISE = Noise()

    class Params(Bundle, frozen=True):
        noise_absolute: float = NOISE.absolute
"""

from __future__ import annotations

import ast
from collections.abc import Callable

import msgspec


class Class(msgspec.Struct, frozen=True):
    """bases: as they are written;  fields: annotated names, with the expressions of their defaults"""

    bases: list[str]
    fields: dict[str, str]


class Names(msgspec.Struct, frozen=True):
    """Of a module.  classes: by name;  imported: the module and the name there, by the name here;  instances: the class, by name"""

    classes: dict[str, Class]
    imported: dict[str, tuple[str, str]]
    instances: dict[str, str]


def names_of(tree: ast.Module) -> Names:
    """What the top level of a module defines and takes `from` others."""
    classes, imported, instances = {}, {}, {}
    for node in tree.body:
        if isinstance(node, ast.ClassDef):
            fields = [item for item in node.body if isinstance(item, ast.AnnAssign) and isinstance(item.target, ast.Name)]
            defaults = {item.target.id: ast.unparse(item.value) if item.value else "none" for item in fields}
            classes[node.name] = Class([ast.unparse(base) for base in node.bases], defaults)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            imported |= {alias.asname or alias.name: (node.module, alias.name) for alias in node.names}
        elif isinstance(node, ast.Assign):
            for target, value in _pairs(node):
                if isinstance(value, ast.Call) and not value.args and not value.keywords:
                    instances[ast.unparse(target)] = ast.unparse(value.func)
    return Names(classes, imported, instances)


def _pairs(node: ast.Assign) -> list[tuple[ast.expr, ast.expr]]:
    """A, B = x, y as two assignments."""
    (target, *others), value = node.targets, node.value
    if not others and isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple) and len(target.elts) == len(value.elts):
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
