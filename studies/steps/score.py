"""Errors of a case's answer against the truth of its world: writes <case>.json.

Pictures are spheres, whatever was observed: all normals of the half sphere toward the viewer.  They are compared by
DSSIM inside the disc after the tone map of `factorlib.evaluate.picture_errors`, nothing scaled but for the gauge
(`studies.recovery_errors`).

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
    colour         of lights: mean angle between the colours of a mirror sphere in the recovered and in the true light
    tint           deviation over channels of the log of the factor that takes recovered reflectances to true ones

Nulls: what a guess scores that knows nothing but mean colours.
"""

from collections.abc import Iterable, Mapping
from pathlib import Path

import msgspec
import numpy as np
from jaxtyping import Float

from factorlib.evaluate.ball import octahedral_light
from factorlib.evaluate.comparison_gauge import material_components
from factorlib.evaluate.picture_errors import picture_error, white_level
from factorlib.evaluate.relighting import INSIDE, Appearances
from factorlib.evaluate.truth import GREY
from factorlib.jsonfile import read_json, write_json
from factorlib.results.materials import SolvedMaterial, read_materials
from factorlib.stage import Inputs, Progress
from studies.recovery_errors import (
    Materials,
    gauge_factor,
    in_gauge,
    light_errors,
    material_errors,
    read_recovered_maps,
    scale_reflectance,
)
from studies.spheres import Maps, materials_of, read_maps
from studies.steps import Params
from studies.study import Case, Score, World, light_name

LEAST = 1e-3  # of a reflectance, below which a relative standard error means nothing


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Compare the answer of a case with all materials and lights of its world, and write the scores."""
    case = msgspec.convert(inputs.facts["dataset.case"], Case)
    world = msgspec.convert(inputs.facts["dataset.worlds"], World)
    folder = inputs["solve"] / inputs.photo
    maps = read_maps(inputs["worlds"], case.seed, range(world.lights))
    materials = read_materials(folder / "materials.json").materials
    recovered = read_recovered_maps(folder, case.lights)
    score = score_case(case, materials_of(case.seed, case.names), maps, materials, recovered)
    write_json(out / f"{inputs.photo}.json", score | Score(read_json(folder / "measured.json")))


def score_case(
    case: Case, truths: Materials, maps: Maps, solved: Mapping[str, SolvedMaterial], recovered: Maps
) -> Score:
    """Return all scores of a case.

    Args:
        case: Case that was solved.
        truths: All true materials of the world.
        maps: All true lights of the world.
        solved: Materials of the solve, in its own gauge.
        recovered: Lights of the solve, in its own gauge.
    """
    component = material_components({light_name(li): case.names_in(li) for li in case.lights})
    estimates = {name: solved[name].reflectance for name in component}
    materials = {}
    lights = {}
    for number in set(component.values()):  # each in the truth's gauge
        members = {n: estimates[n] for n in case.material_names if component[n] == number}
        lit = {li: recovered[li] for li in case.lights if component[case.names_in(li)[0]] == number}
        scaled = in_gauge(members, lit, truths)
        materials |= scaled[0]
        lights |= scaled[1]
    score = sphere_errors(case, materials, lights, truths, maps) | material_errors(estimates, truths, component)
    score |= stated_errors([solved[n] for n in component]) | light_errors(lights, maps)
    if len(set(component.values())) > 1:  # each component has a tint of its own
        return score
    tint = float(np.std(np.log(gauge_factor(estimates, truths))))
    colours = {"chromaticity": recovered, "true_chromaticity": {li: maps[li] for li in recovered}}
    return score | Score({name: chromaticity(case_colours) for name, case_colours in colours.items()} | {"tint": tint})


def stated_errors(table: Iterable[SolvedMaterial]) -> Score:
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


def sphere_errors(case: Case, materials: Materials, lights: Maps, truths: Materials, maps: Maps) -> Score:
    """Return DSSIM of the predicted spheres, and of those of nulls: mean colours, grey materials.

    Args:
        case: Case that was solved.
        materials: Recovered materials, in the truth's gauge.
        lights: Recovered lights, in the truth's gauge.
        truths: All true materials of the world.
        maps: All true lights of the world.
    """
    true = {li: Appearances(octahedral_light(light)) for li, light in maps.items()}
    recovered = {li: Appearances(octahedral_light(light)) for li, light in lights.items()}

    def dssim(samples: Float[np.ndarray, "_ 3"], name: str, light: int) -> float:
        truth = _disc(true[light].ball(truths[name]))
        return picture_error(_disc(samples), truth, INSIDE, white_level(truth, INSIDE)).dssim

    names = case.material_names
    pairs = [(name, li) for name in names for li in lights]
    observed = [pair for pair in pairs if (case.names.index(pair[0]), pair[1]) in case.entries]
    subsets = {"entries": pairs, "observed": observed, "unobserved": [p for p in pairs if p not in observed]}
    errors = {(n, li): dssim(recovered[li].ball(materials[n]), n, li) for n, li in pairs}
    flat = {(n, li): dssim(true[li].ball(truths[n]).mean(axis=0, keepdims=True), n, li) for n, li in pairs}
    means = (
        {key: _mean(each[p] for p in subset) for key, subset in subsets.items() if subset} for each in (errors, flat)
    )
    relit = {n: _mean(dssim(true[li].ball(materials[n]), n, li) for li in true) for n in names}
    values = {"new_light": _mean(relit.values())}
    values |= {"first_material": relit[case.names[0]]} if case.names[0] in relit else {}
    values |= (
        {"first_light": _mean(dssim(recovered[0].ball(m), n, 0) for n, m in truths.items())} if 0 in lights else {}
    )
    grey = scale_reflectance(GREY, gauge_factor(dict.fromkeys(names, GREY), truths))
    return Score(*means) | Score(
        values, {"new_light": _mean(dssim(true[li].ball(grey), n, li) for n in names for li in true)}
    )


def _disc(samples: Float[np.ndarray, "_ 3"]) -> Float[np.ndarray, "h w 3"]:
    disc = np.zeros((*INSIDE.shape, 3))
    disc[INSIDE] = samples
    return disc


def _mean(values: Iterable[float]) -> float:
    return float(np.mean(list(values)))
