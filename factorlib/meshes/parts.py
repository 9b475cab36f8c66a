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
        cure = f"join parts of one material: at most {MOST_PARTS:,} are read"
        raise InputError(f"has {parts:,} parts", file=file, cure=cure)


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
    parts, default = ({}, made_of) if isinstance(made_of, str) else (made_of or {}, None)
    for part, material in [*parts.items(), *overrides.items(), *([(None, default)] if default is not None else [])]:
        if part is not None and part not in there:
            cure = did_you_mean(part, [one_line(name) for name in there])
            raise InputError(f"the mesh has no part {part!r}", file=file, key=part, cure=cure)
        if material not in materials:
            cure = did_you_mean(material, materials)
            raise InputError(f"unknown material {material!r}", file=file, key=part, cure=cure)

    def label(goes_by: tuple[str, ...]) -> int:
        """The label of a part by all its names."""
        called = one_line(" / ".join(goes_by)) or "(unnamed)"
        for mapping in (overrides, parts):
            chosen = {mapping[name] for name in goes_by if name in mapping}
            if len(chosen) > 1:
                found = f"part {called} gets several materials: {', '.join(sorted(chosen))}"
                raise InputError(found, file=file, cure="name it once")
            if chosen:
                return list(materials).index(chosen.pop()) + 1
        if default is None:
            entry = (
                f"add it to `parts`, e.g. {one_line(goes_by[0])}: {materials[0]}"
                if goes_by
                else "give it a name in a mesh editor"
            )
            raise InputError(f"part {called} has no material", file=file, key=called, cure=entry)
        return list(materials).index(default) + 1

    return np.array([label(each) for each in names], dtype=np.int16)
