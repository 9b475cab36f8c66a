"""Errors of a solve's answer: in the truth's gauge, of materials and of lights, each beside that of a guess.

The gauge is what no observation tells, a factor per channel between the materials and the lights of a connected
component.  The true materials fix it.
"""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from factorlib.evaluate.ball import octahedral_light
from factorlib.evaluate.relighting import SPHERES, compare_lights
from factorlib.evaluate.truth import common_factor, compare_materials
from factorlib.light.latlong import lat_long_of_lobes
from factorlib.results.lobe_table import read_lobes
from factorlib.results.materials import Reflectance
from studies.spheres import Map
from studies.study import Score, light_name

PARTS = ("diffuse", "specular", "roughness")
ROWS = 128  # of the maps of recovered lights, as the stage `export` writes them
Materials = Mapping[str, Reflectance]


def read_recovered_maps(solve: Path, numbers: Iterable[int]) -> dict[int, Map]:
    """Return the recovered lights by number, in the solve's own gauge; `solve` is the folder of its result."""
    lobes = read_lobes(solve / "lobes.parquet")
    return {li: lat_long_of_lobes(lobes[light_name(li)], ROWS, 2 * ROWS) for li in numbers}


def gauge_factor(materials: Materials, truths: Materials) -> Float[np.ndarray, "3"]:
    """Return the factor that brings materials nearest to the true materials of the same names."""
    return np.array(common_factor(list(materials.values()), [truths[name] for name in materials]))


def scale_reflectance(material: Reflectance, factor: Float[np.ndarray, "3"]) -> Reflectance:
    """Return a material with k_d and k_s times a factor."""
    diffuse, specular = (tuple((np.array(k) * factor).tolist()) for k in (material.diffuse, material.specular))
    return Reflectance(diffuse, specular, material.roughness)


def in_gauge(
    materials: Materials, lights: Mapping[int, Map], truths: Materials
) -> tuple[dict[str, Reflectance], dict[int, Map]]:
    """Multiply materials by the factor to the truth, and divide lights by it: they predict the same pictures."""
    factor = gauge_factor(materials, truths)
    scaled = {name: scale_reflectance(material, factor) for name, material in materials.items()}
    return scaled, {li: light / factor for li, light in lights.items()}


def material_errors(
    materials: Materials, truths: Materials, component: Mapping[str, int], parts: Sequence[str] = PARTS
) -> Score:
    """Return means over materials, one factor per channel and component taken out; the null is grey."""
    errors = compare_materials(materials, truths, component)
    return Score(*({part: getattr(errors, prefix + part) for part in parts} for prefix in ("mean_", "null_mean_")))


def light_errors(lights: Mapping[str, Map], truths: Mapping[str, Map], gauge: str = "none") -> Score:
    """Return RMSE of white spheres over the truth's RMS, means over the recovered lights, and `colour`.

    `colour` is a mirror sphere's angle between true and recovered colours.  The null is constant light of the true
    mean.
    gauge: of `factorlib.evaluate.comparison_gauge`
    """
    compared = ({str(name): octahedral_light(maps[name]) for name in lights} for maps in (lights, truths))
    errors = compare_lights(*compared, {}).mean[gauge]

    def scores(side: str) -> dict[str, float]:
        """Return the errors of the estimate or of the null."""
        rmse = {sphere: getattr(errors[sphere], side).rmse for sphere in SPHERES}
        return rmse | {"colour": getattr(errors["mirror"], side).rgb_angle_deg}

    return Score(scores("estimate"), scores("null"))
