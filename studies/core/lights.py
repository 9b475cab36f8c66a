"""The lights that a solve found, as maps and as what is reflected, in the solve's own gauge."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from jaxtyping import Float

from factorlib.evaluate.ball import Light, light_of_lat_long
from factorlib.light.latlong import lat_long_of_lobes
from factorlib.results.lobes import Lobes, read_lobes
from studies.core.case import light_name

ROWS = 128  # of their maps, as the stage `export` writes them


def map_of(lobes: Lobes) -> Float[np.ndarray, "h w 3"]:
    """Radiance of a light, lat-long."""
    return lat_long_of_lobes(lobes, ROWS, 2 * ROWS)


def maps_of(solved: Path, numbers: Iterable[int]) -> dict[int, Float[np.ndarray, "h w 3"]]:
    """Of the lights of these numbers; solved: the folder that `solve` wrote."""
    lobes = read_lobes(solved / "lobes.parquet")
    return {li: map_of(lobes[light_name(li)]) for li in numbers}


def lights_of(solved: Path, numbers: Iterable[int]) -> dict[int, Light]:
    """The same, ready to be reflected."""
    return {li: light_of_lat_long(radiance) for li, radiance in maps_of(solved, numbers).items()}
