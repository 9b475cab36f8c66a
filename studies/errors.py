"""Errors of what was solved: in the truth's gauge, of materials and of lights, each beside that of a guess.

The gauge is what no observation tells, a factor per channel between the materials and the lights of a connected
component.  The true materials fix it.
"""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from factorlib.evaluate.ball import octahedral_light
from factorlib.evaluate.light_errors import SPHERES, compare_lights
from factorlib.evaluate.material_errors import common_factor, compare_materials
from factorlib.light.latlong import lat_long_of_lobes
from factorlib.results.lobe_table import read_lobes
from factorlib.results.materials import Reflectance
from studies.study import Score, light_name

PARTS = ("diffuse", "specular", "roughness")
ROWS = 128  # of the maps of recovered lights, as the stage `export` writes them
Map = Float[np.ndarray, "h w 3"]


def maps_of(solved: Path, numbers: Iterable[int]) -> dict[int, Map]:
    """Return the recovered lights of these numbers, in the solve's own gauge; solved: the folder that `solve` wrote."""
    lobes = read_lobes(solved / "lobes.parquet")
    return {li: lat_long_of_lobes(lobes[light_name(li)], ROWS, 2 * ROWS) for li in numbers}


def factor_of(materials: Mapping[str, Reflectance], truths: Mapping[str, Reflectance]) -> Float[np.ndarray, "3"]:
    """Return the factor that takes the materials nearest to the true ones of their names."""
    return np.array(common_factor(list(materials.values()), [truths[name] for name in materials]))


def times(material: Reflectance, factor: Float[np.ndarray, "3"]) -> Reflectance:
    """Return a material that reflects so many times as much."""
    diffuse, specular = (tuple((np.array(k) * factor).tolist()) for k in (material.diffuse, material.specular))
    return Reflectance(diffuse, specular, material.roughness)


def in_gauge(
    materials: Mapping[str, Reflectance], lights: Mapping[int, Map], truths: Mapping[str, Reflectance]
) -> tuple[dict[str, Reflectance], dict[int, Map]]:
    """Multiply materials by the factor to the truth, and divide lights by it: together they show what they did."""
    factor = factor_of(materials, truths)
    return {name: times(m, factor) for name, m in materials.items()}, {li: of / factor for li, of in lights.items()}


def material_errors(
    materials: Mapping[str, Reflectance],
    truths: Mapping[str, Reflectance],
    component: Mapping[str, int],
    parts: Sequence[str] = PARTS,
) -> Score:
    """Return means over materials, one factor per channel and component taken out; the null is grey."""
    errors = compare_materials(materials, truths, component)
    return Score(*({part: getattr(errors, prefix + part) for part in parts} for prefix in ("mean_", "null_mean_")))


def light_errors(
    lights: Mapping[str, Map], truths: Mapping[str, Map], gauge: str = "none", spheres: Sequence[str] = SPHERES
) -> Score:
    """Return RMSE of white spheres over the truth's RMS, means over the recovered lights.

    The null is constant light of the true mean.

    gauge: of `factorlib.evaluate.comparison_gauge`;  to these a mirror sphere's angle between true and recovered
    colours: `colour`
    """
    both = ({str(name): octahedral_light(of[name]) for name in lights} for of in (lights, truths))
    errors = compare_lights(*both, {}).mean[gauge]
    scores = ({s: getattr(errors[s], w).rmse for s in spheres} for w in ("estimate", "null"))
    colours = ({"colour": getattr(errors["mirror"], w).rgb_angle_deg} for w in ("estimate", "null"))
    return Score(*scores) | Score(*colours)
