"""A rendered set solved with one part of the model switched off, and how far that is from the truth: writes <case>.json.

Asked for are cells of mirror directions that no solve has seen, the same whatever is off.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from jaxtyping import Float, Int

from factorlib.dataset.read import read_dataset
from factorlib.diagnose.answer import Answer
from factorlib.geometry.sphere import mirror_cells
from factorlib.images.exr import read_rgb_exr
from factorlib.jsonfile import write_json
from factorlib.light.latlong import lat_long_of_lobes
from factorlib.model.blocks import Block
from factorlib.model.illumination import Illumination
from factorlib.model.loss import Loss
from factorlib.model.noise import Noise
from factorlib.model.observed import blocks_of_observations
from factorlib.model.problem import JointProblem
from factorlib.reflection import reflection_operator
from factorlib.results.materials import Reflectance
from factorlib.solve.few_lobes.history import Run
from factorlib.solve.few_lobes.options import FewLobes
from factorlib.solve.few_lobes.solve import few_lobes
from factorlib.stage import Inputs, Progress
from factorlib.urm.merge import merge
from factorlib.urm.observations import Observations, concatenate, read_observations
from studies.errors import ROWS, light_errors, material_errors
from studies.measured.tools import threaded
from studies.steps import Params
from studies.study import Score

GAUGE = "channel_per_photo"  # of lights: what no photo tells is taken out
CELL, SHARE, MERGE_DEGREES = 0.1, 0.15, 2.0  # of the sphere; of the cells that are asked for
CHANGES = {  # what is done to the observations that a solve may see
    "sure": lambda o: msgspec.structs.replace(o, confidence=None, weight=np.ones(len(o), o.weight.dtype)),
    "unclipped": lambda o: msgspec.structs.replace(o, clipped=np.zeros_like(o.clipped)),
    "dropped": lambda o: o.take(~o.clipped.any(axis=1)),
}


class Split(msgspec.Struct, frozen=True):
    """A light's observations that a solve may see, and those that it is asked for."""

    seen: Block
    asked: Block

    def error(self, radiance: Float[np.ndarray, "n 3"]) -> float:
        """RMSE of what is asked for, of values that are not clipped, over the peak of what is seen."""
        off = np.where(self.asked.clipped, 0.0, radiance - self.asked.radiance)
        return float(np.sqrt(np.mean(off**2)) / np.quantile(self.seen.radiance, 0.999))


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Solve and compare."""
    case = inputs.facts["dataset.case"]
    home = inputs["photos"] / str(case["seed"])
    photos = [read_observations(file) for file in sorted((home / "urm").glob("*.parquet"))]
    write_json(out / f"{inputs.photo}.json", score_of(case["solve"], home / "data", photos))


def score_of(how: dict[str, Any], folder: Path, photos: Sequence[Observations]) -> Score:
    """Solve what a set shows but for the cells that are asked for, and compare with these and with the truth.

    how: options of the solver of few lobes, `robust_scale` of the loss, effects that are off, and `seen`, of `CHANGES`
    """
    truth, operator, lobes = read_dataset(folder), reflection_operator("network"), {**how}
    names, seen, _ = list(truth.spec.materials), lobes.pop("seen", None), lobes.pop("solver", None)
    loss, effects = (
        Loss(lobes.pop("robust_scale", Loss().robust_scale)),
        [lobes.pop(e, True) for e in ("shadows", "bounces")],
    )
    splits = splits_of(photos, seen)
    problem = JointProblem([split.seen for split in splits], operator, loss, threaded).with_effects(*effects)
    solution = few_lobes(problem, len(names), Run(FewLobes(**{"tolerance": 1e-3} | lobes)))
    of, errors = solution.point.materials, []
    for split, light in zip(splits, solution.point.lights, strict=True):
        block = solution.shown(JointProblem([split.asked], operator)).blocks[0]  # with what it took of visibility
        errors.append(split.error(Illumination(block, light, of, operator).radiance()))
    values = {
        "unseen": float(np.mean(errors)),
        "kept_parts": float(solution.shadows.kept + solution.interreflection.kept),
    }
    score = Score(values, {"unseen": float(np.mean([split.error(flat(split)) for split in splits]))})
    observed = sorted({int(m) for split in splits for m in np.unique(split.seen.material)})
    rows = zip(of.diffuse.tolist(), of.specular.tolist(), of.roughness.tolist(), strict=True)
    every = [Reflectance(tuple(diffuse), tuple(specular), roughness) for diffuse, specular, roughness in rows]
    table = {names[m]: every[m] for m in observed}
    truths = {n: Reflectance(m.diffuse, m.specular, m.roughness) for n, m in truth.truth.materials.items()}
    answer = Answer(names, JointProblem([split.seen for split in splits], operator), solution, {}, "few_lobes")
    lights = {name: lat_long_of_lobes(light, ROWS, 2 * ROWS) for name, light in answer.lights().items()}
    maps = {name: read_rgb_exr(truth.folder / truth.truth.illumination[name]) for name in lights}
    score |= material_errors(table, truths, dict.fromkeys(table, 0))
    return score | light_errors(lights, maps, GAUGE, ("glossy", "mirror"))


def splits_of(photos: Sequence[Observations], change: str | None = None) -> list[Split]:
    """Every light's observations.  change: of `CHANGES`, to those that a solve may see; those asked for are the same whatever is done."""
    changed = [CHANGES[change](photo) for photo in photos] if change else photos
    every, seen = (
        {b.name: b for b in blocks_of_observations(concatenate([merge(p, MERGE_DEGREES) for p in of]), Noise())}
        for of in (photos, changed)
    )
    splits = []
    for name, whole in every.items():
        cells = _cells(whole)
        kinds = np.unique(cells)
        chosen = kinds[np.random.default_rng(17).random(len(kinds)) < SHARE]
        left = seen[name].take(~np.isin(_cells(seen[name]), chosen))
        splits.append(Split(left, whole.take(np.isin(cells, chosen) & np.isin(whole.material, left.material))))
    return splits


def _cells(block: Block) -> Int[np.ndarray, " n"]:
    return mirror_cells(block.normal, block.view, CELL)


def flat(split: Split) -> Float[np.ndarray, "n 3"]:
    """Each material's mean colour in each photo."""
    guess = np.zeros_like(split.asked.radiance)
    for m, f in {*zip(split.asked.material.tolist(), split.asked.photo.tolist(), strict=True)}:
        of, like = ((b.material == m) & (b.photo == f) for b in (split.asked, split.seen))
        guess[of] = split.seen.radiance[like if like.any() else split.seen.material == m].mean(0)
    return guess
