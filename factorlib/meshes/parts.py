"""Which material each part of a mesh is of, by the names its file gives the part and those that a dataset uses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from factorlib.errors import InputError, did_you_mean
from factorlib.reading import one_line

MOST_PARTS = 100_000  # of one file


def check_count(parts: int, file: str | Path) -> None:
    """Raise InputError for more than MOST_PARTS parts in one file."""
    if parts > MOST_PARTS:
        raise InputError(f"has {parts:,} parts", file=file, cure=f"join parts of one material: at most {MOST_PARTS:,} are read")


def part_labels(
    names: Sequence[tuple[str, ...]],
    materials: Sequence[str],
    made_of: Mapping[str, str] | str | None,
    overrides: Mapping[str, str],
    file: str | Path,
) -> np.ndarray:
    """Material label (int16, from 1) of each part of a file, given the names it goes by.

    made_of: part -> material, or the material of all parts;  overrides: part -> material, which go before it

    >>> part_labels([("shell",), ("legs", "wood")], ["red", "oak"], {"shell": "red", "wood": "oak"}, {}, "a.obj").tolist()
    [1, 2]
    """
    there = sorted({name for each in names for name in each})
    parts, material = ({}, made_of) if isinstance(made_of, str) else (made_of or {}, None)
    for mapping in (parts, overrides):
        for part, chosen in mapping.items():
            if part not in there:
                raise InputError(f"the mesh has no part {part!r}", file=file, key=part, cure=did_you_mean(part, [one_line(name) for name in there]))
            _check_material(chosen, materials, part, file)
    if material is not None:
        _check_material(material, materials, None, file)
    return np.array([_label(each, materials, parts, material, overrides, file) for each in names], dtype=np.int16)


def _label(
    names: tuple[str, ...],
    materials: Sequence[str],
    parts: Mapping[str, str],
    default: str | None,
    overrides: Mapping[str, str],
    file: str | Path,
) -> int:
    for mapping in (overrides, parts):
        chosen = {mapping[name] for name in names if name in mapping}
        if len(chosen) > 1:
            raise InputError(f"part {_called(names)} gets several materials: {', '.join(sorted(chosen))}", file=file, cure="name it once")
        if chosen:
            return list(materials).index(chosen.pop()) + 1
    if default is None:
        part = _called(names)
        cure = f"add it to `parts`, e.g. {_called(names[:1])}: {materials[0]}" if names else "give it a name in a mesh editor"
        raise InputError(f"part {part} has no material", file=file, key=part, cure=cure)
    return list(materials).index(default) + 1


def _called(names: Sequence[str]) -> str:
    """A part by all its names, as messages write it."""
    return one_line(" / ".join(names)) or "(unnamed)"


def _check_material(name: str, materials: Sequence[str], part: str | None, file: str | Path) -> None:
    if name not in materials:
        raise InputError(f"unknown material {name!r}", file=file, key=part, cure=did_you_mean(name, materials))
