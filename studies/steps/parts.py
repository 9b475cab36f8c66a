"""A rendered set solved with one part of the model switched off, and how far that is from the truth: writes <case>.json."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from factorlib.dataset.read import read_dataset
from factorlib.diagnose.answer import Answer
from factorlib.evaluate.ball import light_of_lat_long
from factorlib.images.exr import read_rgb_exr
from factorlib.jsonfile import write_json
from factorlib.model.problem import JointProblem
from factorlib.reflection import reflection_operator
from factorlib.results.materials import Reflectance
from factorlib.stage import Inputs, Progress
from factorlib.urm.observations import read_observations
from studies.errors import light_errors, map_of, material_errors
from studies.splits import flat, solved, splits_of, unseen
from studies.steps import Params
from studies.study import Score

GAUGE = "channel_per_photo"  # of lights: what no photo tells is taken out


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Solve and compare."""
    case = inputs.facts["dataset.case"]
    folder, urm = inputs["sets"] / str(case["seed"]), inputs["photos"] / str(case["seed"]) / "urm"
    write_json(out / f"{inputs.photo}.json", score_of(case["solve"], folder, urm))


def score_of(how: dict[str, Any], folder: Path, urm: Path) -> Score:
    """Solve what a set shows but for the cells that are asked for, and compare with these and with the truth.

    how: options of `studies.splits.solved`
    """
    truth, operator = read_dataset(folder), reflection_operator("network")
    names = list(truth.spec.materials)
    splits = splits_of([read_observations(file) for file in sorted(urm.glob("*.parquet"))], {}, how.get("seen"))
    blocks = [split.seen for split in splits]
    solution = solved(blocks, len(names), operator, how)
    answer = Answer(names, JointProblem(blocks, operator), solution, {}, "few_lobes")
    values = {
        "unseen": relative(unseen(splits, solution, operator)),
        "kept_parts": float(solution.shadows.kept + solution.interreflection.kept),
    }
    of, observed = solution.point.materials, sorted({names[m] for block in blocks for m in np.unique(block.material)})
    table = {
        n: Reflectance(tuple(of.diffuse[k].tolist()), tuple(of.specular[k].tolist()), float(of.roughness[k]))
        for k, n in enumerate(names)
        if n in observed
    }
    truths = {n: Reflectance(m.diffuse, m.specular, m.roughness) for n, m in truth.truth.materials.items()}
    lights = {name: light_of_lat_long(map_of(lobes)) for name, lobes in answer.lights().items()}
    maps = {name: read_rgb_exr(truth.folder / truth.truth.illumination[name]) for name in lights}
    true_lights = {name: light_of_lat_long(radiance) for name, radiance in maps.items()}
    of_cells = Score(values, {"unseen": relative([flat(split) for split in splits])})
    of_materials = material_errors(table, truths, dict.fromkeys(table, 0))
    return of_cells | of_materials | light_errors(lights, true_lights, GAUGE, ("glossy", "mirror"))


def relative(decibels: Sequence[float]) -> float:
    """Mean over lights of the RMSE over the peak, of PSNRs.

    >>> relative([20.0, 40.0])
    0.055
    """
    return float(np.mean([10 ** (-value / 20) for value in decibels]))
