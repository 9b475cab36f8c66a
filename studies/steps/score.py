"""How far a case's answer is from the truth of its world: writes <case>.json.

Pictures are spheres, whatever was observed: all normals of the half sphere toward the viewer.  They are compared by DSSIM inside the
disc after the tone map of `factorlib.evaluate.picture`, nothing scaled but for the gauge (`studies.errors`).

    entries        recovered materials in recovered lights: every entry of the observed rows and columns; observed, unobserved: those
                   entries alone; no factor is in it where a material and a light are connected
    new_light      recovered materials in all true lights of the world, those that the case never saw among them
    new_material   all true materials of the world in the recovered lights, those that the case never saw among them
    first_material, first_light   of those, the material 0 and the light 0 of the world alone, which cases of all sizes share

The rest are errors of the materials' numbers, of three spheres in the recovered lights, the standard errors that the solve states, the
seconds that it took, and how coloured lights are, which is what the paper's prior acts on:

    chromaticity   of lights: deviation over the three channels of their mean radiances, over the mean of these.  Before that each channel
                   is divided by its geometric mean over the case's lights, the gauge, in answers and truths alike
    colour         mean angle between the colours of a mirror sphere in the recovered and in the true light
    tint           deviation over channels of the log of the factor that takes recovered reflectances to true ones

Nulls: what a guess scores that knows nothing but mean colours.  Of objects, for the first seed, pictures are written beside:
balls-<case>.png and matrix-<case>.png.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import msgspec
import numpy as np
from jaxtyping import Float, UInt8

from factorlib.evaluate.ball import Light, constant_light
from factorlib.evaluate.gauge import connected_components
from factorlib.evaluate.lights import compare_lights
from factorlib.evaluate.materials import GREY
from factorlib.evaluate.picture import picture_error, white_of
from factorlib.evaluate.relighting import INSIDE, Appearances
from factorlib.images.picture import picture, png_bytes, read_png, write_png
from factorlib.jsonfile import read_json, write_json
from factorlib.results.materials import Reflectance, Solved, read_materials
from factorlib.stage import Inputs, Progress
from studies.errors import Answer, factor_of, in_true_gauge, light_errors, lights_of, material_errors, times
from studies.spheres import materials_of, read_lights
from studies.steps import Params
from studies.study import Case, Score, Setting, World, case_name, light_name, named

LEAST = 1e-3  # of a reflectance, below which a relative standard error means nothing
LARGER, RIM, MOST, GAP = 2, 3, 14, 10  # of pictures: pixels of a pixel, of a rim; settings side by side; pixels between

Pixels = UInt8[np.ndarray, "h w 3"]


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Compare with all lights of the world."""
    case, world = (msgspec.convert(inputs.facts[f"dataset.{n}"], t) for n, t in (("case", Case), ("worlds", World)))
    observed, solved = (inputs[step] / inputs.photo for step in ("observe", "solve"))
    lights = read_lights(inputs["worlds"], case.seed, range(world.lights))
    score, spheres = scored(case, materials_of(case.seed, case.names), solved, lights)
    values = {"seconds": read_json(solved / "seconds.json")}
    if case.objects:
        values["normals"] = read_json(observed / "normals.json")
        if case.seed == world.seeds[0]:
            last = world.lights - 1  # a light that hardly any case has seen
            columns = [spheres.column(last, true) for true in (True, False)]
            write_png(out / f"balls-{inputs.photo}.png", np.concatenate(columns, axis=1))
            both = [spheres.matrix(true) for true in (True, False)]
            gap = np.zeros((len(both[0]), 24, 3), np.uint8)
            write_png(out / f"matrix-{inputs.photo}.png", np.concatenate([both[0], gap, both[1]], axis=1))
    write_json(out / f"{inputs.photo}.json", score | Score(values))


def scored(
    case: Case, truths: Mapping[str, Reflectance], solved: Path, lights: Mapping[int, Light]
) -> tuple[Score, Spheres]:
    """The scores of the files that `solve` wrote, and the spheres that they compare; truths, lights: all true ones of the world."""
    table, own_lights = read_materials(solved / "materials.json").materials, lights_of(solved, case.lights)
    component = connected_components({light_name(li): case.names_in(li) for li in case.lights})
    table = {n: table[n] for n in component}
    spheres = Spheres(case, in_true_gauge(case, table, own_lights, truths, component), truths, lights)
    reflectances = {n: m.reflectance for n, m in table.items()}
    score = spheres.score() | material_errors(reflectances, truths, component) | stated_errors(table)
    score |= light_errors(named(spheres.answer.lights), named(lights))
    if len(set(component.values())) == 1:  # else each component has a tint of its own
        score |= tints(reflectances, truths, own_lights, spheres.answer.lights, lights)
    return score, spheres


def stated_errors(table: Mapping[str, Solved]) -> Score:
    """Means over materials of the standard errors that the solve states: of roughness, and of k_d + k_s relative to it."""
    sums = {n: np.maximum(np.add(m.diffuse, m.specular), LEAST) for n, m in table.items()}
    relative = [np.mean(np.hypot(m.stderr.diffuse, m.stderr.specular) / sums[n]) for n, m in table.items()]
    roughness = [m.stderr.roughness for m in table.values()]
    return Score({"stated_roughness": float(np.mean(roughness)), "stated_reflectance": float(np.mean(relative))})


def tints(
    materials: Mapping[str, Reflectance], truths: Mapping[str, Reflectance], own: Mapping[int, Light], scaled: Mapping[int, Light],
    true: Mapping[int, Light],
) -> Score:  # fmt: skip
    """How coloured lights are; own: recovered lights in the solve's gauge, scaled: in the truth's."""
    mirror = compare_lights(named(scaled), named(true), {}).mean["none"]["mirror"]
    values = {
        "chromaticity": chromaticity(list(own.values())),
        "true_chromaticity": chromaticity([true[li] for li in own]),
        "colour": mirror.estimate.rgb_angle_deg,
        "tint": float(np.std(np.log(factor_of(materials, truths)))),
    }
    return Score(values, {"colour": mirror.null.rgb_angle_deg})


def chromaticity(lights: Sequence[Light]) -> float:
    """Of lights that share materials; 0 where all have one colour.

    >>> one = chromaticity([constant_light(np.array(c)) for c in ((1.0, 2.0, 3.0), (2.0, 4.0, 6.0))])
    >>> round(one, 6), round(chromaticity([constant_light(np.array(c)) for c in ((4.0, 1.0, 1.0), (1.0, 1.0, 1.0))]), 3)
    (0.0, 0.318)
    """
    means = np.stack([light.mean for light in lights]).clip(1e-9)
    free = means / np.exp(np.log(means).mean(axis=0))
    return float(np.mean(free.std(axis=1) / free.mean(axis=1)))


class Spheres:
    """Spheres of true and recovered materials in true and recovered lights, each rendered once."""

    def __init__(self, case: Case, answer: Answer, truths: Mapping[str, Reflectance], lights: Mapping[int, Light]):
        self.case, self.answer, self.truths = case, answer, truths
        self.true = {li: Appearances(light) for li, light in lights.items()}
        self.recovered = {li: Appearances(light) for li, light in answer.lights.items()}
        self.inside = INSIDE

    def truth(self, name: str, light: int) -> Float[np.ndarray, "n 3"]:
        """Radiance of a true material in a true light, a row for each pixel inside the disc."""
        return self.true[light].ball(self.truths[name])

    def answered(self, name: str, light: int) -> Float[np.ndarray, "n 3"]:
        """Likewise of a recovered material in a recovered light."""
        return self.recovered[light].ball(self.answer.materials[name])

    def score(self) -> Score:
        """DSSIM of what is predicted, and of what nulls predict."""
        return self._of_entries() | self._of_all()

    def _of_entries(self) -> Score:
        """Recovered materials in recovered lights; the null knows each true sphere's mean colour."""
        entries = {(n, li) for n in self.case.material_names for li in self.case.lights}
        observed = {(self.case.names[m], li) for m, li in self.case.entries}
        parts = {"entries": entries, "observed": observed, "unobserved": entries - observed}
        errors = {e: self._dssim(self.answered(*e), *e) for e in entries}
        flat = {e: self._dssim(self.truth(*e).mean(axis=0, keepdims=True), *e) for e in entries}
        return Score(*({p: _mean(of[e] for e in sorted(es)) for p, es in parts.items() if es} for of in (errors, flat)))

    def _of_all(self) -> Score:
        """Recovered materials in all true lights, and all true materials in the recovered lights."""
        names, lights, white = self.case.material_names, self.case.lights, Appearances(constant_light(np.ones(3)))
        grey, recovered = times(GREY, factor_of(dict.fromkeys(names, GREY), self.truths)), self.answer.materials
        true, every = self.true, self.truths.items()
        of_names = {n: _mean(self._dssim(true[li].ball(recovered[n]), n, li) for li in true) for n in names}
        of_lights = {li: _mean(self._dssim(self.recovered[li].ball(m), n, li) for n, m in every) for li in lights}
        values = {"new_light": _mean(of_names.values()), "new_material": _mean(of_lights.values())}
        values |= {"first_material": of_names[first]} if (first := self.case.names[0]) in of_names else {}
        values |= {"first_light": of_lights[0]} if 0 in of_lights else {}
        greys = (self._dssim(true[li].ball(grey), n, li) for n in names for li in true)
        constants = (self._dssim(white.ball(m) * true[li].light.mean, n, li) for n, m in every for li in lights)
        return Score(values, {"new_light": _mean(greys), "new_material": _mean(constants)})

    def _dssim(self, predicted: Float[np.ndarray, "_ 3"], name: str, light: int) -> float:
        truth = self._disc(self.truth(name, light))
        return picture_error(self._disc(predicted), truth, self.inside, white_of(truth, self.inside)).dssim

    def _disc(self, samples: Float[np.ndarray, "_ 3"]) -> Float[np.ndarray, "h w 3"]:
        disc = np.zeros((*self.inside.shape, 3))
        disc[self.inside] = samples
        return disc

    # pictures for people: 8-bit sRGB, each exposed for its truth, with a rim of black

    def column(self, light: int, true: bool = False) -> Pixels:
        """Spheres of the recovered materials, or of the true ones, one below the other, in a true light."""
        of, names = self.truths if true else self.answer.materials, self.case.material_names
        return np.concatenate([self._shown(self.true[light].ball(of[n]), n, light) for n in names])

    def matrix(self, true: bool = False) -> Pixels:
        """All materials in all lights, recovered or true; entries that were observed have a bright frame."""
        rows = [[self._cell(m, li, true) for li in self.case.lights] for m in self.case.materials]
        return np.concatenate([np.concatenate(row, axis=1) for row in rows])

    def _cell(self, material: int, light: int, true: bool) -> Pixels:
        name = self.case.names[material]
        cell = self._shown((self.truth if true else self.answered)(name, light), name, light)
        if (material, light) in self.case.entries:
            cell[:2], cell[-2:], cell[:, :2], cell[:, -2:] = 200, 200, 200, 200
        return cell

    def _shown(self, samples: Float[np.ndarray, "n 3"], name: str, light: int) -> Pixels:
        white = white_of(self._disc(self.truth(name, light)), self.inside)
        sphere = picture(self._disc(samples), 1 / white)
        return np.pad(sphere.repeat(LARGER, axis=0).repeat(LARGER, axis=1), ((RIM, RIM), (RIM, RIM), (0, 0)))


def _mean(values: Iterable[float]) -> float:
    return float(np.mean(list(values)))


def spheres_by_setting(settings: Sequence[Setting], seeds: Sequence[int], scores: Path) -> dict[str, tuple[str, bytes]]:
    """PNG files by name, with captions: recovered spheres, a column for each setting, the truth first; as many files as it takes."""
    files, seed = {}, seeds[0]
    rows = ", ".join(settings[0].case(seed).material_names)
    for number in range(0, len(settings), MOST):
        some = settings[number : number + MOST]
        pairs = [read_png(scores / f"balls-{case_name(s.name, seed)}.png") for s in some]
        half, gap = pairs[0].shape[1] // 2, np.full((len(pairs[0]), GAP, 3), 255, np.uint8)
        whole = np.concatenate([pairs[0][:, :half], gap, *(pair[:, half:] for pair in pairs)], axis=1)
        caption = (
            f"Seed {seed}: {rows} (rows), each a sphere in a light that is in few photos; truth, then recovered from: "
        )
        caption += ", ".join(s.label for s in some) + "."
        files[f"spheres-{number // MOST + 1}.png"] = (caption, png_bytes(whole))
    return files


def matrices(settings: Sequence[Setting], seeds: Sequence[int], scores: Path) -> dict[str, tuple[str, bytes]]:
    """PNG files by name, with captions: each setting's materials (rows) in its lights (columns), true and recovered."""
    files, seed = {}, seeds[0]
    for s in settings:
        caption = f"{s.label}, seed {seed}: {', '.join(s.case(seed).material_names)} (rows) in the set's lights (columns); left the truth, "
        caption += "right recovered materials in recovered lights.  Frames: observed entries."
        files[f"{s.name}.png"] = (caption, (scores / f"matrix-{case_name(s.name, seed)}.png").read_bytes())
    return files
