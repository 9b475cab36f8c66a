"""Errors of what was solved: in the truth's gauge, of materials and of lights, each beside that of a guess.

The gauge is what no observation tells, a factor per channel between the materials and the lights of a connected component.  The true
materials fix it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import msgspec
import numpy as np
from jaxtyping import Float

from factorlib.evaluate.ball import Light, light_of_lat_long
from factorlib.evaluate.lights import SPHERES, compare_lights
from factorlib.evaluate.materials import common_factor, compare_materials
from factorlib.light.latlong import lat_long_of_lobes
from factorlib.results.lobes import Lobes, read_lobes
from factorlib.results.materials import Reflectance
from studies.study import Case, Score, light_name

PARTS = ("diffuse", "specular", "roughness")
ROWS = 128  # of the maps of recovered lights, as the stage `export` writes them


class Answer(msgspec.Struct, frozen=True):
    """What was solved, in the truth's gauge: materials by name, lights by number."""

    materials: dict[str, Reflectance]
    lights: dict[int, Light]


def map_of(lobes: Lobes) -> Float[np.ndarray, "h w 3"]:
    """Radiance of a recovered light, lat-long."""
    return lat_long_of_lobes(lobes, ROWS, 2 * ROWS)


def maps_of(solved: Path, numbers: Iterable[int]) -> dict[int, Float[np.ndarray, "h w 3"]]:
    """The recovered lights of these numbers as maps, in the solve's own gauge; solved: the folder that `solve` wrote."""
    lobes = read_lobes(solved / "lobes.parquet")
    return {li: map_of(lobes[light_name(li)]) for li in numbers}


def lights_of(solved: Path, numbers: Iterable[int]) -> dict[int, Light]:
    """The same, ready to be reflected."""
    return {li: light_of_lat_long(radiance) for li, radiance in maps_of(solved, numbers).items()}


def factor_of(materials: Mapping[str, Reflectance], truths: Mapping[str, Reflectance]) -> Float[np.ndarray, "3"]:
    """The factor that takes the materials nearest to the true ones of their names."""
    return np.array(common_factor(list(materials.values()), [truths[name] for name in materials]))


def times(material: Reflectance, factor: Float[np.ndarray, "3"]) -> Reflectance:
    """A material that reflects so many times as much."""
    diffuse, specular = (tuple((np.array(k) * factor).tolist()) for k in (material.diffuse, material.specular))
    return Reflectance(diffuse, specular, material.roughness)


def in_true_gauge(
    case: Case, table: Mapping[str, Reflectance], lights: Mapping[int, Light], truths: Mapping[str, Reflectance], component: Mapping[str, int]
) -> Answer:  # fmt: skip
    """Each component's materials times its factor per channel, its lights divided by it.

    component: of each material by name, as `connected_components` numbers them
    """
    names = {number: [n for n in case.material_names if component[n] == number] for number in component.values()}
    factor = {number: factor_of({n: table[n] for n in of}, truths) for number, of in names.items()}
    of_light = {li: factor[component[case.names_in(li)[0]]] for li in case.lights}
    scaled = {li: tuple((level / f).astype(np.float32) for level in lights[li].levels) for li, f in of_light.items()}
    materials = {n: times(table[n], factor[component[n]]) for n in case.material_names}
    return Answer(materials, {li: Light(levels) for li, levels in scaled.items()})


def material_errors(
    materials: Mapping[str, Reflectance], truths: Mapping[str, Reflectance], component: Mapping[str, int], parts: Sequence[str] = PARTS
) -> Score:  # fmt: skip
    """Means over materials, one factor per channel and component taken out; the null is grey."""
    errors = compare_materials(materials, truths, component)
    return Score(*({part: getattr(errors, prefix + part) for part in parts} for prefix in ("mean_", "null_mean_")))


def light_errors(
    lights: Mapping[str, Light], truths: Mapping[str, Light], gauge: str = "none", spheres: Sequence[str] = SPHERES
) -> Score:
    """RMSE of white spheres over the truth's RMS, means over the recovered lights; the null is constant light of the true mean.

    gauge: of `factorlib.evaluate.gauge`
    """
    errors = compare_lights(lights, truths, {}).mean[gauge]
    return Score(*({s: getattr(errors[s], which).rmse for s in spheres} for which in ("estimate", "null")))
