"""Solved materials, and the gauge in which other programs accept them.

Mitsuba refuses reflectances above one, and its mixture (see `factorlib.export.mitsuba`) needs
max k_d + max k_s ≤ 1 − 1e-5 of every material.  Only the product of reflectance and light is known, so where a
material exceeds that, one factor for the whole set moves from all reflectances into all lights: every material in
every light keeps its radiance, also across photos that share nothing.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from factorlib.errors import InputError
from factorlib.jsonfile import read_json

HEADROOM = 1e-5
SCALED = ("diffuse", "specular")
RULE = "where max diffuse + max specular of a material exceeds 1 - 1e-5, one factor moves from all reflectances to all lights"

Vec3 = tuple[float, float, float]


class Material(msgspec.Struct, frozen=True):
    """Lambert k_d and GGX k_s per channel (linear Rec. 709), roughness in [0, 1] with α = roughness²."""

    diffuse: Vec3
    specular: Vec3
    roughness: float

    @property
    def alpha(self) -> float:
        return self.roughness**2

    @property
    def total(self) -> float:
        """max k_d + max k_s."""
        return max(self.diffuse) + max(self.specular)

    def scaled(self, factor: float) -> Material:
        """All reflectances times `factor`."""
        return Material(*(tuple(factor * v for v in colour) for colour in (self.diffuse, self.specular)), self.roughness)


def materials_of_table(table: Mapping[str, Any]) -> dict[str, Material]:
    """The materials in the content of materials.json, in its order of names."""
    return {n: Material(tuple(m["diffuse"]), tuple(m["specular"]), m["roughness"]) for n, m in table["materials"].items()}


def read_materials(path: str | Path) -> dict[str, Material]:
    """Materials by name from a materials.json."""
    try:
        return materials_of_table(read_json(path))
    except (KeyError, TypeError) as error:
        raise InputError(f"no table of materials ({error!r} is missing)", file=path, cure="run the stage that writes it again") from error


def headroom_factor(materials: Mapping[str, Material]) -> float:
    """What reflectances are to be multiplied by: 1 where all materials fit already.

    >>> headroom_factor({"red": Material((0.9, 0.1, 0.1), (0.1, 0.1, 0.3), 0.3)})
    0.8333250000000001
    """
    brightest = max((m.total for m in materials.values()), default=0.0)
    limit = 1 - HEADROOM
    return 1.0 if brightest <= limit else limit / brightest


def table_in_gauge(table: Mapping[str, Any], factor: float) -> dict[str, Any]:
    """The content of materials.json with reflectances and their standard errors times `factor`, which `gauge` then tells."""
    gauge = {**table.get("gauge", {}), "export_factor": factor, "export_rule": RULE}
    return {**table, "materials": {name: _scaled(entry, factor) for name, entry in table["materials"].items()}, "gauge": gauge}


def _scaled(entry: Mapping[str, Any], factor: float) -> dict[str, Any]:
    result = {**entry, **{key: (factor * np.asarray(entry[key])).tolist() for key in SCALED}}
    if "stderr" in entry:
        result["stderr"] = {**entry["stderr"], **{key: (factor * np.asarray(entry["stderr"][key])).tolist() for key in SCALED}}
    return result
