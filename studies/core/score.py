"""How far a solve is from the truth of its world.

Pictures are spheres, compared by DSSIM inside the disc after the tone map of `factorlib.evaluate.picture`, nothing scaled but
for one thing: what no observation tells, a factor per channel between the materials and the lights of a connected
component, is taken out first (`common_factor`, from the materials).

    entries        recovered materials in recovered lights: every entry of the rows and columns that were seen; observed,
                   unobserved: those entries alone; no factor is in it where a material and a light are connected
    new_light      recovered materials in all true lights of the world, those that the case never saw among them
    new_material   all true materials of the world in the recovered lights, those that the case never saw among them
    first_material, first_light   of those, the material 0 and the light 0 of the world alone, which cases of all sizes share

The rest are errors of the materials' numbers, of the three spheres in the recovered lights (RMSE over the truth's RMS), and
the standard errors that the solve states.  Nulls: what a guess scores that knows nothing but mean colours.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

import msgspec
import numpy as np
from jaxtyping import Float

from factorlib.evaluate.ball import Light, constant_light, light_of_lat_long
from factorlib.evaluate.gauge import connected_components
from factorlib.evaluate.lights import compare_lights
from factorlib.evaluate.materials import GREY, common_factor, compare_materials
from factorlib.evaluate.picture import picture_error, white_of
from factorlib.evaluate.relighting import Appearances
from factorlib.light.latlong import lat_long_of_lobes
from factorlib.results.lobes import read_lobes
from factorlib.results.materials import Reflectance, Solved, read_materials
from studies.core.case import NAMES, Case, Score, light_name
from studies.core.world import materials_of

MAP_ROWS = 128  # of recovered lights, as the stage `export` writes them
LEAST = 1e-3  # of a reflectance, below which a relative standard error means nothing


class Answer(msgspec.Struct, frozen=True):
    """What was solved, in the truth's gauge: materials by name, lights by number."""

    materials: dict[str, Reflectance]
    lights: dict[int, Light]


def score_of(case: Case, solved: Path, lights: Mapping[int, Light]) -> Score:
    """The scores of the files that `solve` wrote; lights: all true ones of the world."""
    table = read_materials(solved / "materials.json").materials
    truths = materials_of(case.seed)
    component = connected_components({light_name(li): [NAMES[m] for m, at in case.entries if at == li] for li in case.lights})
    answer = in_true_gauge(case, table, _lights(case, solved), truths, component)
    pictures = Pictures(case, answer, truths, lights)
    values, nulls = pictures.scores()
    errors = compare_materials({n: table[n].reflectance for n in component}, truths, component)
    for part in ("diffuse", "specular", "roughness"):
        values[part], nulls[part] = getattr(errors, f"mean_{part}"), getattr(errors, f"null_mean_{part}")
    spheres = compare_lights(*({light_name(li): of[li] for li in case.lights} for of in (answer.lights, lights)), {})
    for view in ("mirror", "glossy", "matte"):
        scored = spheres.mean["none"][view]
        values[view], nulls[view] = scored.estimate.rmse, scored.null.rmse
    return Score(values | stated_errors({n: table[n] for n in component}), nulls)


def _lights(case: Case, solved: Path) -> dict[int, Light]:
    lobes = read_lobes(solved / "lobes.parquet")
    return {li: light_of_lat_long(lat_long_of_lobes(lobes[light_name(li)], MAP_ROWS, 2 * MAP_ROWS)) for li in case.lights}


def in_true_gauge(
    case: Case,
    table: Mapping[str, Reflectance],
    lights: Mapping[int, Light],
    truths: Mapping[str, Reflectance],
    component: Mapping[str, int],
) -> Answer:
    """Each component's materials times its factor per channel, its lights divided by it."""
    materials, scaled = {}, {}
    for number in sorted(set(component.values())):
        names = [n for n in case.material_names if component[n] == number]
        factor = np.array(common_factor([table[n] for n in names], [truths[n] for n in names]))
        materials |= {n: _times(table[n], factor) for n in names}
        for li in {at for m, at in case.entries if NAMES[m] in names}:
            scaled[li] = Light(tuple((level / factor).astype(np.float32) for level in lights[li].levels))
    return Answer(materials, {li: scaled[li] for li in case.lights})


def _times(material: Reflectance, factor: Float[np.ndarray, "3"]) -> Reflectance:
    diffuse, specular = (tuple((np.array(k) * factor).tolist()) for k in (material.diffuse, material.specular))
    return Reflectance(diffuse, specular, material.roughness)


def stated_errors(table: Mapping[str, Solved]) -> dict[str, float]:
    """Means over materials of the standard errors that the solve states: of roughness, and of k_d + k_s relative to it."""
    relative = [
        float(np.mean(np.hypot(m.stderr.diffuse, m.stderr.specular) / np.maximum(np.add(m.diffuse, m.specular), LEAST))) for m in table.values()
    ]
    return {
        "stated_roughness": float(np.mean([m.stderr.roughness for m in table.values()])),
        "stated_reflectance": float(np.mean(relative)),
    }


class Pictures:
    """Spheres of true and recovered materials in true and recovered lights, each rendered once."""

    def __init__(self, case: Case, answer: Answer, truths: Mapping[str, Reflectance], lights: Mapping[int, Light]):
        self.case, self.answer, self.truths = case, answer, truths
        self.true = {li: Appearances(light) for li, light in lights.items()}
        self.found = {li: Appearances(light) for li, light in answer.lights.items()}
        self.inside = next(iter(self.true.values())).inside

    def scores(self) -> tuple[dict[str, float], dict[str, float]]:
        """DSSIM of what is predicted, and of what nulls predict."""
        case, names = self.case, self.case.material_names
        entries = {(n, li): self._entry(n, li) for n in names for li in case.lights}
        observed = {(NAMES[m], li) for m, li in case.entries}
        parts = {"entries": entries, "observed": entries.keys() & observed, "unobserved": entries.keys() - observed}
        values = {part: _mean(entries[e] for e in sorted(of)) for part, of in parts.items() if of}
        flat = _mean(self._dssim(self._truth(n, li).mean(axis=0, keepdims=True), n, li) for n, li in entries)
        grey = _times(GREY, np.array(common_factor([GREY] * len(names), [self.truths[n] for n in names])))
        in_lights = {n: _mean(self._dssim(self.true[li].ball(self.answer.materials[n]), n, li) for li in self.true) for n in names}
        of_materials = {li: _mean(self._dssim(self.found[li].ball(of), n, li) for n, of in self.truths.items()) for li in case.lights}
        values |= {"new_light": _mean(in_lights.values()), "new_material": _mean(of_materials.values())}
        values |= {"first_material": in_lights[NAMES[0]]} if NAMES[0] in in_lights else {}
        values |= {"first_light": of_materials[0]} if 0 in of_materials else {}
        return values, dict.fromkeys(parts.keys() & values.keys(), flat) | {
            "new_light": _mean(self._dssim(self.true[li].ball(grey), n, li) for n in names for li in self.true),
            "new_material": self._null_of_lights(),
        }

    def _entry(self, name: str, light: int) -> float:
        return self._dssim(self.found[light].ball(self.answer.materials[name]), name, light)

    def _null_of_lights(self) -> float:
        """Of constant lights of the true ones' mean colours."""
        white = Appearances(constant_light(np.ones(3)))
        return _mean(self._dssim(white.ball(of) * self.true[li].light.mean, n, li) for n, of in self.truths.items() for li in self.case.lights)

    def _truth(self, name: str, light: int) -> Float[np.ndarray, "n 3"]:
        return self.true[light].ball(self.truths[name])

    def _dssim(self, predicted: Float[np.ndarray, "_ 3"], name: str, light: int) -> float:
        truth = self._picture(self._truth(name, light))
        return picture_error(self._picture(predicted), truth, self.inside, white_of(truth, self.inside)).dssim

    def _picture(self, samples: Float[np.ndarray, "_ 3"]) -> Float[np.ndarray, "h w 3"]:
        picture = np.zeros((*self.inside.shape, 3))
        picture[self.inside] = samples
        return picture


def _mean(values: Iterable[float]) -> float:
    return float(np.mean(list(values)))
