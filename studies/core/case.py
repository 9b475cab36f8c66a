"""The unit of work of all studies: a case is one set of observations, solved once and compared with the truth.

A case belongs to a world, which its seed names: five materials on spheres, and as many lights at most.  It sees some entries of
the matrix of materials × lights, perhaps perturbed, and is asked for all entries of its rows and columns.  Cases of equal seeds
show equal materials in equal lights, so that settings are compared seed by seed.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import msgspec

from studies.core.entries import Entries

NAMES = ("brick", "leaf", "lacquer", "chalk", "gold")  # of the materials of every world


class Case(Entries, frozen=True, forbid_unknown_fields=True):
    """What one solve sees.

    size:          pixels across a sphere
    normal_deg:    normals are turned by |N(0, normal_deg)| degrees toward random sides
    wrong_labels:  share of each sphere's pixels whose label names another material of the same photo
    facets:        faces that the object shows instead of a sphere (`studies.core.observed.faceted`); None: a sphere
    solve:         parameters of the stage `solve` that differ from their defaults
    """

    names: ClassVar[tuple[str, ...]] = NAMES

    size: int
    normal_deg: float = 0.0
    wrong_labels: float = 0.0
    facets: int | None = None
    solve: dict[str, Any] = msgspec.field(default_factory=dict)


class World(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How the lights of worlds are made: of which seeds, how many each, how finely."""

    seeds: tuple[int, ...]
    lights: int
    rows: int
    spp: int


class Score(msgspec.Struct, frozen=True):
    """values: by measure;  nulls: of those that have one.  A measure that the case does not have is left out."""

    values: dict[str, float]
    nulls: dict[str, float] = {}

    def __or__(self, other: Score) -> Score:
        """The measures of both."""
        return Score(self.values | other.values, self.nulls | other.nulls)


def light_name(light: int) -> str:
    """Of the illumination, and of the photo that is in it."""
    return f"light{light}"


def named(lights: Mapping[int, Any]) -> dict[str, Any]:
    """What lights are by number, by their names."""
    return {light_name(li): of for li, of in lights.items()}
