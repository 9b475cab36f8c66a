"""The unit of work of all studies: a case is one set of observations, solved once and compared with the truth.

A case belongs to a world, which its seed names: five materials on spheres, and as many lights at most.  It sees some entries of
the matrix of materials × lights, perhaps harmed, and is asked for all entries of its rows and columns.  Cases of equal seeds
show equal materials in equal lights, so that settings are compared seed by seed.
"""

from __future__ import annotations

from typing import Any

import msgspec

NAMES = ("brick", "leaf", "lacquer", "chalk", "gold")  # of the materials of every world

Entry = tuple[int, int]  # a material and a light


class Case(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What one solve sees.

    entries:       observed ones
    size:          pixels across a sphere
    normal_deg:    normals are turned by |N(0, normal_deg)| degrees toward random sides
    wrong_labels:  share of each sphere's pixels whose label names another material of the same photo
    facets:        faces that the object shows instead of a sphere (`studies.core.observed.faceted`); None: a sphere
    solve:         parameters of the stage `solve` that differ from their defaults
    """

    seed: int
    entries: tuple[Entry, ...]
    size: int
    normal_deg: float = 0.0
    wrong_labels: float = 0.0
    facets: int | None = None
    solve: dict[str, Any] = {}

    @property
    def materials(self) -> list[int]:
        """Those that are seen, in order."""
        return sorted({m for m, _ in self.entries})

    @property
    def material_names(self) -> list[str]:
        """The same by name, in the order of their numbers in the case's observations."""
        return [NAMES[m] for m in self.materials]

    @property
    def lights(self) -> list[int]:
        """Those that are seen, in order."""
        return sorted({li for _, li in self.entries})


class World(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How the lights of worlds are made: of which seeds, how many each, how finely."""

    seeds: tuple[int, ...]
    lights: int
    rows: int
    spp: int


class Score(msgspec.Struct, frozen=True):
    """values: by measure;  nulls: of those that have one.  A measure that the case does not have is left out."""

    values: dict[str, float]
    nulls: dict[str, float]


def light_name(light: int) -> str:
    """Of the illumination, and of the photo that is in it."""
    return f"light{light}"
