"""Errors of a case's answer against the truth of its world: writes <case>.json.

Pictures are spheres, whatever was observed: all normals of the half sphere toward the viewer.  They are compared by
DSSIM inside the disc after the tone map of `factorlib.evaluate.picture_errors`, nothing scaled but for the gauge
(`studies.errors`).

    entries        recovered materials in recovered lights: every entry of the observed rows and columns; observed,
                   unobserved: those entries alone; no factor is in it where a material and a light are connected
    new_light      recovered materials in all true lights of the world, those that the case never saw among them
    first_material   the recovered material 0 in all true lights; first_light: all true materials in the recovered light
                     0.  Cases of all sizes share these two

The rest are errors of the materials' numbers, of three spheres in the recovered lights, the standard errors that the
solve states, the seconds that it took, and how coloured lights are, which is what the paper's prior acts on:

    chromaticity   of lights: deviation over the three channels of their mean radiances, over the mean of these.  Before
                   that each channel is divided by its geometric mean over the case's lights, the gauge, in answers and
                   truths alike
    colour         mean angle between the colours of a mirror sphere in the recovered and in the true light
    tint           deviation over channels of the log of the factor that takes recovered reflectances to true ones

Nulls: what a guess scores that knows nothing but mean colours.  Of objects, for the first seed, <case>.png shows all
materials (rows) in all lights, the truth and, right of it, what was recovered; entries that were observed have a bright
frame.
"""

from collections.abc import Iterable, Mapping
from pathlib import Path

import msgspec
import numpy as np
from jaxtyping import Float, UInt8

from factorlib.evaluate.ball import octahedral_light
from factorlib.evaluate.comparison_gauge import connected_components
from factorlib.evaluate.material_errors import GREY
from factorlib.evaluate.picture_errors import picture_error, white_of
from factorlib.evaluate.relighting import INSIDE, Appearances
from factorlib.images.picture import picture, write_png
from factorlib.jsonfile import read_json, write_json
from factorlib.results.materials import Reflectance, Solved, read_materials
from factorlib.stage import Inputs, Progress
from studies.errors import Map, factor_of, in_gauge, light_errors, maps_of, material_errors, times
from studies.spheres import materials_of, read_maps
from studies.steps import Params
from studies.study import Case, Score, World, light_name

LEAST = 1e-3  # of a reflectance, below which a relative standard error means nothing
Table = Mapping[str, Reflectance]
Maps = Mapping[int, Map]


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Compare with all lights of the world."""
    case, world = (msgspec.convert(inputs.facts[f"dataset.{n}"], t) for n, t in (("case", Case), ("worlds", World)))
    truths = materials_of(case.seed, case.names)
    solved = inputs["solve"] / inputs.photo
    maps = read_maps(inputs["worlds"], case.seed, range(world.lights))
    table = read_materials(solved / "materials.json")
    spheres, score = scored(case, truths, maps, table.materials, maps_of(solved, case.lights))
    write_json(out / f"{inputs.photo}.json", score | Score(read_json(solved / "measured.json")))
    if case.objects and case.seed == world.seeds[0]:
        write_png(out / f"{inputs.photo}.png", np.concatenate([spheres.matrix(true=True), spheres.matrix()], axis=1))


def scored(case: Case, truths: Table, maps: Maps, table: Mapping[str, Solved], own: Maps) -> "tuple[Spheres, Score]":
    """Return the spheres that are compared, and all scores.

    truths, maps: all true materials and lights of the world;  table, own: those that were solved, in the solve's own
                  gauge
    """
    component = connected_components({light_name(li): case.names_in(li) for li in case.lights})
    solved = {n: table[n].reflectance for n in component}
    materials = {}
    lights = {}
    for number in set(component.values()):  # each in the truth's gauge
        names = [n for n in case.material_names if component[n] == number]
        of = {li: own[li] for li in case.lights if component[case.names_in(li)[0]] == number}
        some, few = in_gauge({n: solved[n] for n in names}, of, truths)
        materials = materials | some
        lights = lights | few
    spheres = Spheres(case, materials, lights, truths, maps)
    score = spheres.score() | material_errors(solved, truths, component) | stated_errors([table[n] for n in component])
    errors = light_errors(lights, maps)
    if len(set(component.values())) > 1:  # each component has a tint of its own
        return spheres, score | Score(
            *({k: v for k, v in of.items() if k != "colour"} for of in (errors.values, errors.nulls))
        )
    colours = {"chromaticity": chromaticity(own), "true_chromaticity": chromaticity({li: maps[li] for li in own})}
    tint = float(np.std(np.log(factor_of(solved, truths))))
    return spheres, score | errors | Score({**colours, "tint": tint})


def stated_errors(table: Iterable[Solved]) -> Score:
    """Return means over materials of the standard errors that the solve states.

    They are of roughness, and of k_d + k_s relative to it.
    """
    sums = [(np.maximum(np.add(m.diffuse, m.specular), LEAST), m.stderr) for m in table]
    relative = [np.mean(np.hypot(stderr.diffuse, stderr.specular) / whole) for whole, stderr in sums]
    return Score({"stated_roughness": _mean(e.roughness for _, e in sums), "stated_reflectance": _mean(relative)})


def chromaticity(lights: Maps) -> float:
    """Return the chromaticity of lights that share materials; 0 where all have one colour.

    >>> one = {k: np.full((8, 16, 3), c) for k, c in enumerate(((1.0, 2.0, 3.0), (2.0, 4.0, 6.0)))}
    >>> round(chromaticity(one), 6)
    0.0
    """
    means = np.stack([octahedral_light(light).mean for light in lights.values()]).clip(1e-9)
    free = means / np.exp(np.log(means).mean(axis=0))
    return float(np.mean(free.std(axis=1) / free.mean(axis=1)))


class Spheres:
    """Spheres of true and recovered materials in true and recovered lights, each rendered once."""

    def __init__(self, case: Case, materials: Table, lights: Maps, truths: Table, maps: Maps):
        self.case = case
        self.materials = materials
        self.truths = truths
        self.true = {li: Appearances(octahedral_light(light)) for li, light in maps.items()}
        self.own = {li: Appearances(octahedral_light(light)) for li, light in lights.items()}

    def score(self) -> Score:
        """Return DSSIM of the predictions, and of those of nulls: mean colours, grey materials, constant lights."""
        names = self.case.material_names
        own = self.own
        true = self.true
        pairs = [(n, li) for n in names for li in own]
        seen = {(self.case.names[m], li) for m, li in self.case.entries}
        parts = {"entries": pairs, "observed": seen, "unobserved": [e for e in pairs if e not in seen]}
        errors = {(n, li): self._dssim(own[li].ball(self.materials[n]), n, li) for n, li in pairs}
        flat = {
            (n, li): self._dssim(true[li].ball(self.truths[n]).mean(axis=0, keepdims=True), n, li) for n, li in pairs
        }
        score = Score(*({p: _mean(of[e] for e in es) for p, es in parts.items() if es} for of in (errors, flat)))
        of_names = {n: _mean(self._dssim(true[li].ball(self.materials[n]), n, li) for li in true) for n in names}
        values = {"new_light": _mean(of_names.values())}
        values |= {"first_material": of_names[first]} if (first := self.case.names[0]) in of_names else {}
        if 0 in own:
            values["first_light"] = _mean(self._dssim(own[0].ball(m), n, 0) for n, m in self.truths.items())
        grey = times(GREY, factor_of(dict.fromkeys(names, GREY), self.truths))
        greys = (self._dssim(true[li].ball(grey), n, li) for n in names for li in true)
        return score | Score(values, {"new_light": _mean(greys)})

    def _dssim(self, predicted: Float[np.ndarray, "_ 3"], name: str, light: int) -> float:
        truth = _disc(self.true[light].ball(self.truths[name]))
        return picture_error(_disc(predicted), truth, INSIDE, white_of(truth, INSIDE)).dssim

    def matrix(self, true: bool = False) -> UInt8[np.ndarray, "h w 3"]:
        """Draw all materials (rows) in all lights, recovered or true, each exposed for its truth."""
        rows = []
        for m in self.case.materials:
            name = self.case.names[m]
            row = []
            for li in self.case.lights:
                truth = self.true[li].ball(self.truths[name])
                shown = _disc(truth if true else self.own[li].ball(self.materials[name]))
                cell = np.pad(picture(shown, 1 / white_of(_disc(truth), INSIDE)), ((3, 3), (3, 3), (0, 0)))
                if (m, li) in self.case.entries:
                    cell[:2] = 200
                    cell[-2:] = 200
                    cell[:, :2] = 200
                    cell[:, -2:] = 200
                row.append(cell)
            rows.append(np.concatenate(row, axis=1))
        return np.concatenate(rows)


def _disc(samples: Float[np.ndarray, "_ 3"]) -> Float[np.ndarray, "h w 3"]:
    disc = np.zeros((*INSIDE.shape, 3))
    disc[INSIDE] = samples
    return disc


def _mean(values: Iterable[float]) -> float:
    return float(np.mean(list(values)))
