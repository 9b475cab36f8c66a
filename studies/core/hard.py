"""Hard cases by name, of the operator, the solve and alignment; without science, for plans are made of them.

A test compares the names with those of the benchmarks, which know what they mean.
"""

from __future__ import annotations

from typing import Literal

import msgspec

Table = Literal["operator", "solve", "align"]
CASES: dict[Table, tuple[str, ...]] = {
    "operator": (
        "none: ordinary",
        "lobe behind the surface",
        "lobe on the horizon",
        "view at n·o = 10⁻⁴",
        "view along n",
        "roughness .03",
        "roughness 1",
        "sharpness 10⁻⁴",
        "sharpness 10⁶",
        "lobe along n",
        "lobe along −n",
        "lobe along the mirror direction",
        "lobe along o",
        "lobe along −o",
    ),
    "solve": (
        "ordinary: 2 materials × 2 lights",
        "1 material × 1 light",
        "1 material × 5 lights",
        "5 materials × 1 light",
        "unconnected: 2 × 1 and 3 × 1",
        "flat objects",
        "an object of 30 pixels",
        "a single pixel",
        "all Lambertian",
        "all mirror-like: roughness .1",
        "a black material",
        "a light of one point",
        "constant light",
        "radiances × 10⁻⁴",
        "radiances × 10⁴",
        "sun 10⁴ × the sky",
        "half the values clipped",
        "all values clipped",
        "20 % of normals wrong by 40°",
        "normals with noise of 1°",
        "normals with noise of 2°",
        "normals with noise of 5°",
        "normals with noise of 10°",
        "two equal materials",
        "a material without pixels",
        "NaN, infinite, no direction",
    ),
    "align": ("exact", "rough", "wrong mesh", "wrong mask", "mirrored mask", "tiny mask"),
}


class Hard(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A row of a table; the seed is of noise, or of poses; the operator's cases have none.  shapes: that are aligned, at most"""

    seed: int
    table: Table
    case: str
    shapes: int = 99
