"""The answers of the two methods that find a reflectance for each material and a light for each photo: the stage `solve`, and Mitsuba."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from factorlib.light.latlong import lat_long_of_lobes
from factorlib.results.lobes import read_lobes
from factorlib.results.materials import Reflectance, read_materials
from studies.core.baselines.gauge import in_gauge
from studies.core.baselines.joint import Optimised
from studies.core.baselines.prediction import Rendered
from studies.core.case import light_name

MAP_ROWS = 128  # of recovered lights, as the stage `export` writes them


def ours(folder: Path, numbers: list[int], truths: Mapping[str, Reflectance]) -> Rendered:
    """What the stage `solve` wrote; numbers: of the lights.  truths: for the gauge alone."""
    table, lobes = read_materials(folder / "materials.json").materials, read_lobes(folder / "lobes.parquet")
    lights = {li: lat_long_of_lobes(lobes[light_name(li)], MAP_ROWS, 2 * MAP_ROWS) for li in numbers}
    return Rendered(*in_gauge({name: solved.reflectance for name, solved in table.items()}, lights, truths))


def mitsubas(found: Optimised, truths: Mapping[str, Reflectance]) -> Rendered:
    """Where the optimisation ended.  truths: for the gauge alone."""
    return Rendered(*in_gauge(found.materials, {li: np.array(of) for li, of in found.lights.items()}, truths))
