"""Which materials have a specular part: those that held-out observations are explained worse without.

A matte material would lend its specular part to errors of normals and lights.  Each material in turn, the least specular
first, loses its specular part; the rest of the problem is brought to rest again, and if neither its own held-out loss nor
that of all observations has risen by more than `LEAST_GAIN` of itself, the specular part stays away.  A material that
reflects more specularly than diffusely is not tried: where normals are wrong, a dull guess explains held-out highlights
better than the right one, and a dark glossy material would lose all it shows.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import msgspec
import numpy as np
from jaxtyping import Bool

from factorlib.solve.descent import Descent, Solution, descend, evaluated
from factorlib.solve.problem import Block
from factorlib.solve.unknowns import LEAST_REFLECTANCE, Materials

LEAST_GAIN = 0.03  # of the held-out loss, that a specular part must be worth
HOPELESS = 1.3  # times the held-out loss after `GLANCE` iterations: the specular part is needed, and no more is tried
GLANCE, ITERATIONS = 3, 9


class Specular(msgspec.Struct, frozen=True):
    """What decided about a material: the held-out loss of its own observations with and without its specular part,
    None where it has none or was not tried."""

    kept: bool
    held_out_loss_with: float | None
    held_out_loss_without: float | None


def matte_where_it_may_be(
    blocks: Sequence[Block], start: Solution, operator, loss, held_out: Callable[..., float], map_: Callable
) -> tuple[Solution, Bool[np.ndarray, "m"], list[Specular]]:
    """The solution with needless specular parts gone, which materials those are, and the evidence for every material.

    held_out: held-out loss of a solution, or (solution, m) of a material's own observations
    """
    matte = np.zeros(len(start.materials), bool)
    seen = np.isin(np.arange(len(matte)), np.concatenate([block.material for block in blocks]))
    base = start.materials  # all are brought to rest from here alike: held-out loss changes with iterations, too

    def rested(materials: Materials, which: Bool[np.ndarray, "m"], most: float) -> Solution:
        trial = evaluated(blocks, materials, start.lights, operator, loss, map_)
        trial = descend(blocks, trial, operator, loss, Descent(GLANCE), map_, matte=which)
        return trial if held_out(trial) > most else descend(blocks, trial, operator, loss, Descent(ITERATIONS), map_, matte=which)

    chosen = rest = rested(base, matte, np.inf)
    best = held_out(rest)
    evidence = [Specular(True, None, None)] * len(matte)
    for m in np.argsort(base.specular.mean(1), kind="stable"):
        if not seen[m] or base.specular[m].mean() > base.diffuse[m].mean():
            continue
        without = without_specular(base, m)
        trial = rested(without, matte | (np.arange(len(matte)) == m), HOPELESS * best)
        score, own, own_without = held_out(trial), held_out(rest, m), held_out(trial, m)
        needed = score > (1 + LEAST_GAIN) * best or own_without > (1 + LEAST_GAIN) * own
        evidence[m] = Specular(bool(needed), own, own_without)
        if not needed:
            base, rest, chosen, best, matte[m] = without, trial, trial, score, True
    return chosen, matte, evidence


def without_specular(materials: Materials, m: int) -> Materials:
    """Material m with what it reflected specularly given to its diffuse part."""
    diffuse, specular = materials.diffuse.copy(), materials.specular.copy()
    diffuse[m] += specular[m]
    specular[m] = LEAST_REFLECTANCE
    return Materials(diffuse, specular, materials.roughness)
