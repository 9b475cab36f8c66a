"""Cells of mirror directions that no solve has seen: how a set is split, what may be done to what a solve sees, and how well it predicts the rest."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import numpy as np
from jaxtyping import Float, Int

from factorlib.geometry.sphere import mirror_cells
from factorlib.model.blocks import Block
from factorlib.model.illumination import Illumination
from factorlib.model.lights import Light
from factorlib.model.loss import Loss
from factorlib.model.noise import Noise
from factorlib.model.observed import Rotations, blocks_of_observations
from factorlib.model.problem import JointProblem
from factorlib.reflection.operator import Operator
from factorlib.solve.few_lobes.options import FewLobes, Run
from factorlib.solve.few_lobes.solve import few_lobes
from factorlib.solve.history import Solution
from factorlib.urm.merge import merge
from factorlib.urm.observations import Observations, concatenate
from studies.measured.tools import threaded

CELL, SHARE, MERGE_DEGREES = 0.1, 0.15, 2.0
DEFAULT = FewLobes(tolerance=1e-3)
CHANGES = {  # what is done to the observations that a solve may see
    "sure": lambda o: msgspec.structs.replace(o, confidence=None, weight=np.ones(len(o), o.weight.dtype)),
    "unclipped": lambda o: msgspec.structs.replace(o, clipped=np.zeros_like(o.clipped)),
    "dropped": lambda o: o.take(~o.clipped.any(axis=1)),
}


class Split(msgspec.Struct, frozen=True):
    """A light's observations that a solve may see, and those that it is asked for."""

    seen: Block
    asked: Block


def splits_of(photos: Sequence[Observations], rotations: Rotations, change: str | None = None) -> list[Split]:
    """Every light's observations.  change: of `CHANGES`, to those that a solve may see; those asked for are the same whatever is done."""
    changed = [CHANGES[change](photo) for photo in photos] if change else photos
    whole, seen = (
        blocks_of_observations(concatenate([merge(p, MERGE_DEGREES) for p in of]), Noise(), world_from_camera=rotations)
        for of in (photos, changed)
    )
    return [_split(block, next(b for b in seen if b.name == block.name)) for block in whole]


def _split(whole: Block, seen: Block) -> Split:
    cells = _cells(whole)
    names = np.unique(cells)
    chosen = names[np.random.default_rng(17).random(len(names)) < SHARE]
    left = seen.take(~np.isin(_cells(seen), chosen))
    return Split(left, whole.take(np.isin(cells, chosen) & np.isin(whole.material, left.material)))


def _cells(block: Block) -> Int[np.ndarray, " n"]:
    return mirror_cells(block.normal, block.view, CELL)


def solved(blocks: Sequence[Block], materials: int, operator: Operator, how: dict) -> Solution:
    """The solution with lights of few lobes.  how: options of `FewLobes`, of the loss and of the start, and effects that are off."""
    how = {key: value for key, value in how.items() if key not in ("seen", "solver")}
    usual = Loss()
    loss = Loss(how.pop("robust_scale", usual.robust_scale), how.pop("prior", usual.prior))
    effects = how.pop("shadows", True), how.pop("bounces", True)
    problem = JointProblem(list(blocks), operator, loss, threaded).with_effects(*effects)
    return few_lobes(problem, materials, Run(msgspec.structs.replace(DEFAULT, **how)))


def effective(solution: Solution, block: Block, operator: Operator) -> Block:
    """The block with what the solve took of visibility."""
    return solution.shown(JointProblem([block], operator)).blocks[0]


def predicted(solution: Solution, block: Block, light: Light, operator: Operator) -> Float[np.ndarray, "n 3"]:
    """Radiance of a block's observations in a light, by the materials and the model of a solution."""
    block = effective(solution, block, operator)
    return Illumination(block, light, solution.point.materials, operator).radiance()


def decibels(asked: Block, radiance: Float[np.ndarray, "n 3"], whole: Block) -> float:
    """PSNR of observations that are not clipped; whole: the light's, whose peak counts."""
    error = np.where(asked.clipped, 0.0, radiance - asked.radiance)
    return -10 * float(np.log10(max(np.mean(error**2), 1e-12) / np.quantile(whole.radiance, 0.999) ** 2))


def unseen(splits: Sequence[Split], solution: Solution, operator: Operator) -> list[float]:
    """Decibels of each light on the observations that it is asked for."""
    pairs = zip(splits, solution.point.lights, strict=True)
    return [decibels(s.asked, predicted(solution, s.asked, light, operator), s.seen) for s, light in pairs]


def flat(split: Split) -> float:
    """Decibels of each material's mean colour in each photo."""
    guess = np.zeros_like(split.asked.radiance)
    for m, f in {*zip(split.asked.material.tolist(), split.asked.photo.tolist(), strict=True)}:
        of, like = ((b.material == m) & (b.photo == f) for b in (split.asked, split.seen))
        guess[of] = split.seen.radiance[like if like.any() else split.seen.material == m].mean(0)
    return decibels(split.asked, guess, split.seen)
