"""How far a solve of objects is from the truth: the scores of the spheres (`studies.core.score`), of materials of other names.

What was observed are objects, what is compared are spheres of the materials in the lights: all normals of the half sphere toward the
viewer, whichever of them an object showed.  Beside them stand the error of the normals that the solve was given, and the processor
seconds that it took.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import msgspec
import numpy as np
from jaxtyping import Float, UInt8

from factorlib.evaluate.ball import Light, light_of_lat_long
from factorlib.evaluate.gauge import connected_components
from factorlib.evaluate.lights import compare_lights
from factorlib.evaluate.materials import GREY, common_factor, compare_materials
from factorlib.evaluate.picture import white_of
from factorlib.images.picture import picture
from factorlib.light.latlong import lat_long_of_lobes
from factorlib.results.lobes import read_lobes
from factorlib.results.materials import Reflectance, Solved, read_materials
from studies.core.case import Score, light_name
from studies.core.objects.case import SEVEN, ObjectsCase
from studies.core.objects.world import materials_of
from studies.core.score import MAP_ROWS, Answer, Pictures, stated_errors

LARGER = 2  # times the pixels of a ball, in pictures


class Scored(msgspec.Struct, frozen=True):
    """The scores of a case, and its spheres for pictures."""

    score: Score
    pictures: SevenPictures


def scored(case: ObjectsCase, solved: Path, lights: Mapping[int, Light]) -> Scored:
    """Of the files that `solve` wrote; lights: all true ones of the world."""
    table, truths = read_materials(solved / "materials.json").materials, materials_of(case.seed)
    component = connected_components({light_name(li): case.names_in(li) for li in case.lights})
    answer = in_true_gauge(case, table, _lights(case, solved), component)
    pictures = SevenPictures(case, answer, truths, lights)
    values, nulls = pictures.scores()
    errors = compare_materials({n: table[n].reflectance for n in component}, truths, component)
    for part in ("diffuse", "specular", "roughness"):
        values[part], nulls[part] = getattr(errors, f"mean_{part}"), getattr(errors, f"null_mean_{part}")
    spheres = compare_lights(*({light_name(li): of[li] for li in case.lights} for of in (answer.lights, lights)), {})
    for view in ("mirror", "glossy", "matte"):
        of_view = spheres.mean["none"][view]
        values[view], nulls[view] = of_view.estimate.rmse, of_view.null.rmse
    return Scored(Score(values | stated_errors({n: table[n] for n in component}), nulls), pictures)


def _lights(case: ObjectsCase, solved: Path) -> dict[int, Light]:
    lobes = read_lobes(solved / "lobes.parquet")
    return {li: light_of_lat_long(lat_long_of_lobes(lobes[light_name(li)], MAP_ROWS, 2 * MAP_ROWS)) for li in case.lights}


def in_true_gauge(case: ObjectsCase, table: Mapping[str, Solved], lights: Mapping[int, Light], component: Mapping[str, int]) -> Answer:
    """Each component's materials times its factor per channel, its lights divided by it."""
    truths, factor = materials_of(case.seed), {}
    for number in set(component.values()):
        names = [n for n in case.material_names if component[n] == number]
        factor[number] = np.array(common_factor([table[n] for n in names], [truths[n] for n in names]))
    materials = {n: _times(table[n], factor[component[n]]) for n in case.material_names}
    of_light = {li: factor[component[case.names_in(li)[0]]] for li in case.lights}
    return Answer(materials, {li: Light(tuple((lv / of_light[li]).astype(np.float32) for lv in lights[li].levels)) for li in case.lights})


def _times(material: Reflectance | Solved, factor: Float[np.ndarray, "3"]) -> Reflectance:
    diffuse, specular = (tuple((np.array(k) * factor).tolist()) for k in (material.diffuse, material.specular))
    return Reflectance(diffuse, specular, material.roughness)


class SevenPictures(Pictures):
    """Spheres of true and recovered materials in true and recovered lights."""

    case: ObjectsCase

    def scores(self) -> tuple[dict[str, float], dict[str, float]]:
        """DSSIM of what is predicted, and of what nulls predict."""
        case, names = self.case, self.case.material_names
        entries = {(n, li): self._entry(n, li) for n in names for li in case.lights}
        observed = {(SEVEN[m], li) for m, li in case.entries}
        parts = {"entries": entries, "observed": entries.keys() & observed, "unobserved": entries.keys() - observed}
        values = {part: _mean([entries[e] for e in sorted(of)]) for part, of in parts.items() if of}
        flat = {part: _mean([self._flat(n, li) for n, li in sorted(of)]) for part, of in parts.items() if of}
        grey = _times(GREY, np.array(common_factor([GREY] * len(names), [self.truths[n] for n in names])))
        values["new_light"] = _mean([self.of_material(n) for n in names])
        values["first_light"] = _mean([self._dssim(self.found[case.lights[0]].ball(of), n, case.lights[0]) for n, of in self.truths.items()])
        return values, flat | {"new_light": _mean([self._dssim(self.true[li].ball(grey), n, li) for n in names for li in self.true])}

    def of_material(self, name: str) -> float:
        """DSSIM of a recovered material in all true lights of the world."""
        return _mean([self._dssim(self.true[li].ball(self.answer.materials[name]), name, li) for li in self.true])

    def _flat(self, name: str, light: int) -> float:
        """Of a disc of the true sphere's mean colour."""
        return self._dssim(self._truth(name, light).mean(axis=0, keepdims=True), name, light)

    def column(self, light: int, true: bool = False) -> UInt8[np.ndarray, "h w 3"]:
        """Spheres of the recovered materials, or of the true ones, one below the other, in a true light."""
        of = self.truths if true else self.answer.materials
        return np.concatenate([self._shown(self.true[light].ball(of[n]), n, light) for n in self.case.material_names])

    def matrix(self, true: bool = False) -> UInt8[np.ndarray, "h w 3"]:
        """All materials in all lights, recovered or true; entries that were observed have a bright frame."""
        rows = [np.concatenate([self._cell(n, li, true) for li in self.case.lights], axis=1) for n in self.case.material_names]
        return np.concatenate(rows)

    def _cell(self, name: str, light: int, true: bool) -> UInt8[np.ndarray, "h w 3"]:
        ball = self._truth(name, light) if true else self.found[light].ball(self.answer.materials[name])
        cell = self._shown(ball, name, light)
        if (SEVEN.index(name), light) in self.case.entries:
            cell[:2], cell[-2:], cell[:, :2], cell[:, -2:] = 200, 200, 200, 200
        return cell

    def _shown(self, samples: Float[np.ndarray, "n 3"], name: str, light: int) -> UInt8[np.ndarray, "h w 3"]:
        """Exposed for the truth, with a rim of black."""
        shown = picture(self._picture(samples), 1 / white_of(self._picture(self._truth(name, light)), self.inside))
        return np.pad(shown.repeat(LARGER, axis=0).repeat(LARGER, axis=1), ((3, 3), (3, 3), (0, 0)))


def _mean(values: list[float]) -> float:
    return float(np.mean(values))
