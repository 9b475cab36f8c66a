"""Sets of chairs as `factorlib.generate` makes them, from shapes to observations, and how far a solve of one is from the truth.

Photographs have all bounces, a mesh coarser than what was photographed, searched poses, clipped pixels: each part of the model has
something to do.  The stages `masks`, `align` and `urm` themselves turn them into observations.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from factorlib.dataset.read import read_dataset
from factorlib.dataset.schema import Dataset
from factorlib.diagnose.answer import Answer
from factorlib.evaluate.ball import Light, light_of_lat_long
from factorlib.generate.eames import SET, Parameters, generate
from factorlib.images.exr import read_rgb_exr
from factorlib.model.problem import JointProblem
from factorlib.reflection import reflection_operator
from factorlib.results.materials import Reflectance
from factorlib.stage import silent
from factorlib.urm.observations import read_observations
from studies.core.case import Score
from studies.core.errors import light_errors, material_errors
from studies.core.lights import map_of
from studies.core.part import PARTS, Chairs, Part
from studies.core.pipeline import run_stages
from studies.splits import Split, flat, solved, splits_of, unseen

GAUGE = "channel_per_photo"  # of lights: what no photo tells is taken out


def make_set(folder: Path, seed: int, chairs: Chairs) -> None:
    """Generate a set into the empty folder."""
    parameters = Parameters(width=chairs.width, height=chairs.height, light_rows=chairs.light_rows, spp=chairs.spp)
    generate(folder, seed, [], parameters, silent, SET.shots[: chairs.shots])


def observe(folder: Path, out: Path) -> None:
    """masks/, align/ and urm/ of a set, in `out`."""
    run_stages(folder, out, {}, ("masks", "align", "urm"))


def score_of(case: Part, folder: Path, observed: Path) -> Score:
    """Solve what a set shows but for the cells that are asked for, and compare with these and with the truth."""
    dataset, how = read_dataset(folder), {**case.solve, **PARTS[case.part][1]}
    splits = splits_of([read_observations(file) for file in sorted(observed.glob("*.parquet"))], {}, how.get("seen"))
    names, operator = list(dataset.spec.materials), reflection_operator("network")
    blocks = [split.seen for split in splits]
    solution = solved(blocks, len(names), operator, how)
    answer = Answer(names, JointProblem(blocks, operator), solution, {}, "few_lobes")
    values = {"unseen": relative(unseen(splits, solution, operator)), "kept_parts": kept(answer)}
    of_cells = Score(values, {"unseen": relative([flat(split) for split in splits])})
    return of_cells | _of_materials(dataset, answer, splits) | _of_lights(dataset, answer)


def relative(decibels: Sequence[float]) -> float:
    """Mean over lights of the RMSE over the peak, of PSNRs.

    >>> relative([20.0, 40.0])
    0.055
    """
    return float(np.mean([10 ** (-value / 20) for value in decibels]))


def kept(answer: Answer) -> float:
    """How many of shadows and bounce the solve took."""
    found = answer.solution
    return float(found.shadows.kept + found.interreflection.kept)


def _of_materials(dataset: Dataset, answer: Answer, splits: Sequence[Split]) -> Score:
    seen = {answer.names[m] for split in splits for m in np.unique(split.seen.material)}
    of = answer.solution.point.materials
    rows = {
        n: Reflectance(tuple(of.diffuse[k].tolist()), tuple(of.specular[k].tolist()), float(of.roughness[k]))
        for k, n in enumerate(answer.names)
    }
    truths = {n: Reflectance(m.diffuse, m.specular, m.roughness) for n, m in dataset.truth.materials.items()}
    return material_errors({n: rows[n] for n in sorted(seen)}, truths, dict.fromkeys(seen, 0))


def _of_lights(dataset: Dataset, answer: Answer) -> Score:
    found = {name: light_of_lat_long(map_of(lobes)) for name, lobes in answer.lights().items()}
    truths: dict[str, Light] = {
        name: light_of_lat_long(read_rgb_exr(dataset.folder / dataset.truth.illumination[name])) for name in found
    }
    return light_errors(found, truths, GAUGE, ("glossy", "mirror"))
