"""How far a solve is from the truth of its world.

Pictures are spheres, whatever was observed: all normals of the half sphere toward the viewer.  They are compared by DSSIM inside the
disc after the tone map of `factorlib.evaluate.picture`, nothing scaled but for one thing: what no observation tells, a factor per
channel between the materials and the lights of a connected component, is taken out first (`studies.core.gauge`).

    entries        recovered materials in recovered lights: every entry of the rows and columns that were seen; observed,
                   unobserved: those entries alone; no factor is in it where a material and a light are connected
    new_light      recovered materials in all true lights of the world, those that the case never saw among them
    new_material   all true materials of the world in the recovered lights, those that the case never saw among them
    first_material, first_light   of those, the material 0 and the light 0 of the world alone, which cases of all sizes share

The rest are errors of the materials' numbers, of the three spheres in the recovered lights (RMSE over the truth's RMS), and
the standard errors that the solve states.  Nulls: what a guess scores that knows nothing but mean colours; that of observed
entries is of these alone, as that of unobserved ones is.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

import msgspec
import numpy as np
from jaxtyping import Float

from factorlib.evaluate.ball import Light, constant_light
from factorlib.evaluate.gauge import connected_components
from factorlib.evaluate.materials import GREY
from factorlib.evaluate.picture import picture_error, white_of
from factorlib.evaluate.relighting import Appearances
from factorlib.results.materials import Reflectance, Solved, read_materials
from studies.core.case import Score, light_name, named
from studies.core.entries import Entries
from studies.core.errors import light_errors, material_errors
from studies.core.gauge import Answer, factor_of, in_true_gauge, times
from studies.core.lights import lights_of

LEAST = 1e-3  # of a reflectance, below which a relative standard error means nothing


class Scored(msgspec.Struct, frozen=True):
    """The scores of a case, and the spheres that they compare."""

    score: Score
    pictures: Pictures


def scored(case: Entries, truths: Mapping[str, Reflectance], solved: Path, lights: Mapping[int, Light]) -> Scored:
    """Of the files that `solve` wrote; truths, lights: all true ones of the world."""
    table = read_materials(solved / "materials.json").materials
    component = connected_components({light_name(li): case.names_in(li) for li in case.lights})
    answer = in_true_gauge(case, table, lights_of(solved, case.lights), truths, component)
    pictures = Pictures(case, answer, truths, lights)
    materials = material_errors({n: table[n].reflectance for n in component}, truths, component)
    spheres = light_errors(named(answer.lights), named(lights))
    return Scored(pictures.score() | materials | spheres | stated_errors({n: table[n] for n in component}), pictures)


def stated_errors(table: Mapping[str, Solved]) -> Score:
    """Means over materials of the standard errors that the solve states: of roughness, and of k_d + k_s relative to it."""
    relative = [
        float(np.mean(np.hypot(m.stderr.diffuse, m.stderr.specular) / np.maximum(np.add(m.diffuse, m.specular), LEAST)))
        for m in table.values()
    ]
    return Score({
        "stated_roughness": float(np.mean([m.stderr.roughness for m in table.values()])),
        "stated_reflectance": float(np.mean(relative)),
    })  # fmt: skip


class Pictures:
    """Spheres of true and recovered materials in true and recovered lights, each rendered once."""

    def __init__(self, case: Entries, answer: Answer, truths: Mapping[str, Reflectance], lights: Mapping[int, Light]):
        self.case, self.answer, self.truths = case, answer, truths
        self.true = {li: Appearances(light) for li, light in lights.items()}
        self.found = {li: Appearances(light) for li, light in answer.lights.items()}
        self.inside = next(iter(self.true.values())).inside

    def score(self) -> Score:
        """DSSIM of what is predicted, and of what nulls predict."""
        return self._of_entries() | self._of_all()

    def _of_entries(self) -> Score:
        """Recovered materials in recovered lights; the null knows each true sphere's mean colour."""
        entries = {(n, li) for n in self.case.material_names for li in self.case.lights}
        observed = {(self.case.names[m], li) for m, li in self.case.entries}
        parts = {"entries": entries, "observed": observed, "unobserved": entries - observed}
        found = {e: self._dssim(self.recovered(*e), *e) for e in entries}
        flat = {e: self._dssim(self.truth(*e).mean(axis=0, keepdims=True), *e) for e in entries}
        return Score(
            *(
                {part: _mean(error[e] for e in sorted(of)) for part, of in parts.items() if of}
                for error in (found, flat)
            )
        )

    def _of_all(self) -> Score:
        """Recovered materials in all true lights, and all true materials in the recovered lights."""
        names, lights = self.case.material_names, self.case.lights
        grey = times(GREY, factor_of(dict.fromkeys(names, GREY), self.truths))
        in_lights = {
            n: _mean(self._dssim(self.true[li].ball(self.answer.materials[n]), n, li) for li in self.true)
            for n in names
        }
        of_materials = {
            li: _mean(self._dssim(self.found[li].ball(of), n, li) for n, of in self.truths.items()) for li in lights
        }
        values = {"new_light": _mean(in_lights.values()), "new_material": _mean(of_materials.values())}
        values |= {"first_material": in_lights[first]} if (first := self.case.names[0]) in in_lights else {}
        values |= {"first_light": of_materials[0]} if 0 in of_materials else {}
        return Score(values, {
            "new_light": _mean(self._dssim(self.true[li].ball(grey), n, li) for n in names for li in self.true),
            "new_material": self._null_of_lights(),
        })  # fmt: skip

    def _null_of_lights(self) -> float:
        """Of constant lights of the true ones' mean colours."""
        white = Appearances(constant_light(np.ones(3)))
        return _mean(
            self._dssim(white.ball(of) * self.true[li].light.mean, n, li)
            for n, of in self.truths.items()
            for li in self.case.lights
        )

    def truth(self, name: str, light: int) -> Float[np.ndarray, "n 3"]:
        """Radiance of a true material in a true light, a row for each pixel inside the disc."""
        return self.true[light].ball(self.truths[name])

    def recovered(self, name: str, light: int) -> Float[np.ndarray, "n 3"]:
        """Likewise of a recovered material in a recovered light."""
        return self.found[light].ball(self.answer.materials[name])

    def _dssim(self, predicted: Float[np.ndarray, "_ 3"], name: str, light: int) -> float:
        truth = self.picture(self.truth(name, light))
        return picture_error(self.picture(predicted), truth, self.inside, white_of(truth, self.inside)).dssim

    def picture(self, samples: Float[np.ndarray, "_ 3"]) -> Float[np.ndarray, "h w 3"]:
        """Radiance of the pixels inside the disc as a picture, black outside."""
        picture = np.zeros((*self.inside.shape, 3))
        picture[self.inside] = samples
        return picture


def _mean(values: Iterable[float]) -> float:
    return float(np.mean(list(values)))
