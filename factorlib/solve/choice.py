"""Which materials have a specular part: those that held-out observations are explained worse without.

A matte material would lend its specular part to errors of normals and lights.  Each material in turn, the least specular
first, loses its specular part; the rest of the problem is brought to rest again, and if neither its own held-out loss has risen
by more than `LEAST_GAIN` of itself nor that of all observations by more than `MOST_HARM`, the specular part stays away.  A material that
reflects more specularly than diffusely is not tried: where normals are wrong, a dull guess explains held-out highlights
better than the right one, and a dark glossy material would lose all it shows.

With held-out observations out of its sight, a lobe may grow in the part of the light that they alone mirror.  Their loss then rises
by far more than `MOST_HARM`, and says nothing about a specular part: such iterations are not taken.

What is brought to rest for a trial are the `LIGHTS` lights that show most of the material, so that a trial costs the same
however large the set.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import msgspec
import numpy as np
from jaxtyping import Bool, Int

from factorlib.solve.descent import Descent, Solution, descend, evaluated
from factorlib.solve.held_out import Judge
from factorlib.solve.problem import Block
from factorlib.solve.step import specular_unknowns
from factorlib.solve.unknowns import LEAST_REFLECTANCE, Materials

LEAST_GAIN = 0.03  # of its own held-out loss, that a specular part must be worth
MOST_HARM = 0.05  # of all held-out loss, which moves by some 3 % as the descent goes on
HOPELESS = 1.3  # times the held-out loss after `GLANCE` iterations: the specular part is needed, and no more is tried
GLANCE, ITERATIONS = 3, 6
LIGHTS = 8


class Specular(msgspec.Struct, frozen=True):
    """What decided about a material: the held-out loss of its own observations with and without its specular part,
    None where it has none or was not tried."""

    kept: bool
    held_out_loss_with: float | None
    held_out_loss_without: float | None


def matte_where_it_may_be(
    blocks: Sequence[Block],
    start: Solution,
    operator,
    loss,
    losses: Judge,
    map_: Callable,
    decided: Bool[np.ndarray, "m"] | None = None,
    matte: Bool[np.ndarray, "m"] | None = None,
) -> tuple[Solution, Bool[np.ndarray, "m"], list[Specular]]:
    """The solution with needless specular parts gone, which materials those are, and the evidence for every material.

    start: nearly at rest, so that iterations change the held-out loss less than what is decided;
    decided: materials that are not tried;  matte: those that have lost their specular part already
    """
    matte = np.zeros(len(start.materials), bool) if matte is None else matte.copy()
    tried = ~matte if decided is None else ~decided
    count = np.array([np.bincount(block.material, minlength=len(matte)) for block in blocks])
    everywhere = np.arange(len(blocks))

    def rested(of: Int[np.ndarray, "k"], materials: Materials, matte: Bool[np.ndarray, "m"], most: float = np.inf) -> Solution:
        """The lights `of` and the materials, some iterations later, or as they are where those did harm to what is held out.

        Not all the way where a glance at the held-out loss says that it ends above `most`.
        """
        own, held = [blocks[k] for k in of], specular_unknowns(matte)
        before = evaluated(own, materials, [start.lights[k] for k in of], operator, loss, map_)
        after = descend(own, before, operator, loss, Descent(GLANCE), map_, held=held)
        if not (np.isfinite(most) and mean_loss(own, after) > most):
            after = descend(own, after, operator, loss, Descent(ITERATIONS), map_, held=held)
        return after if mean_loss(own, after) <= (1 + MOST_HARM) * mean_loss(own, before) else before

    def mean_loss(own: Sequence[Block], point: Solution) -> float:
        return float(np.concatenate(losses(own, point)).mean())

    base = start.materials  # all go on from here by as many iterations
    chosen = rested(everywhere, base, matte)
    best = losses(blocks, chosen)
    evidence = untried(matte)
    for m in np.argsort(base.specular.mean(1), kind="stable"):
        of = np.sort(np.argsort(-count[:, m], kind="stable")[:LIGHTS])
        of = of[count[of, m] > 0]
        own = np.concatenate([blocks[k].material[blocks[k].held_out] == m for k in of]) if len(of) else np.zeros(0, bool)
        if not tried[m] or not own.any() or base.specular[m].mean() > base.diffuse[m].mean():
            continue
        without, with_ = without_specular(base, m), np.concatenate([best[k] for k in of])
        trial = rested(of, without, matte | (np.arange(len(matte)) == m), HOPELESS * with_.mean())
        found = losses([blocks[k] for k in of], trial)
        without_ = np.concatenate(found)
        needed = without_.mean() > (1 + MOST_HARM) * with_.mean() or without_[own].mean() > (1 + LEAST_GAIN) * with_[own].mean()
        evidence[m] = Specular(bool(needed), float(with_[own].mean()), float(without_[own].mean()))
        if needed:
            continue
        base, matte[m] = without, True
        if len(of) < len(blocks):
            trial = rested(everywhere, base, matte)
            found = losses(blocks, trial)
        chosen, best = trial, found
    return chosen, matte, evidence


def untried(matte: Bool[np.ndarray, "m"]) -> list[Specular]:
    """The evidence where there is none: what was decided before."""
    return [Specular(not is_matte, None, None) for is_matte in matte.tolist()]


def without_specular(materials: Materials, m: int) -> Materials:
    """Material m with what it reflected specularly given to its diffuse part."""
    diffuse, specular = materials.diffuse.copy(), materials.specular.copy()
    diffuse[m] += specular[m]
    specular[m] = LEAST_REFLECTANCE
    return Materials(diffuse, specular, materials.roughness)
