"""The answers of the two methods that find a reflectance for each material and a light for each photo: the stage `solve`, and Mitsuba."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from factorlib.results.materials import Reflectance, read_materials
from studies.core.baselines.gauge import in_gauge
from studies.core.baselines.joint import Optimised
from studies.core.baselines.prediction import Rendered
from studies.core.lights import maps_of


def ours(folder: Path, numbers: list[int], truths: Mapping[str, Reflectance]) -> Rendered:
    """What the stage `solve` wrote; numbers: of the lights.  truths: for the gauge alone."""
    table = read_materials(folder / "materials.json").materials
    return Rendered(
        *in_gauge({name: solved.reflectance for name, solved in table.items()}, maps_of(folder, numbers), truths)
    )


def mitsubas(found: Optimised, truths: Mapping[str, Reflectance]) -> Rendered:
    """Where the optimisation ended.  truths: for the gauge alone."""
    return Rendered(*in_gauge(found.materials, {li: np.array(of) for li, of in found.lights.items()}, truths))
