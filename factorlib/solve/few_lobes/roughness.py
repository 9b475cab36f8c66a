"""A search over all roughnesses with the lights fixed, for descent may end in a wrong local minimum of roughness.

With fixed lights, radiance is linear in k_d and k_s, but not in roughness.  For each roughness of `GRID`, k_d and k_s are solved for
per channel (non-negative least squares), which gives the loss as a function of roughness for each material.  The material is replaced
by the one of least loss, if that is less than `BETTER` times the loss of the present roughness, computed in the same way.
"""

from __future__ import annotations

from functools import partial

import msgspec
import numpy as np
from jaxtyping import Float
from scipy.optimize import nnls

from factorlib.model.illumination import Illumination
from factorlib.model.materials import LEAST_REFLECTANCE, Materials, Point
from factorlib.model.noise import Loss
from factorlib.model.problem import JointProblem

GRID = (0.1, 0.14, 0.19, 0.26, 0.35, 0.46, 0.6, 0.78, 1.0)
ROWS = 300  # observations of each material in each light that are used
BETTER = 0.95  # of the present loss


def materials_of_best_roughness(problem: JointProblem, point: Point) -> Materials:
    """The materials, each replaced where another roughness explains a sample of the observations clearly better."""
    searched = partial(_searched, materials=point.materials, loss=problem.loss)
    found = problem.spread(searched, [(m, _voters(problem, point, m)) for m in range(len(point.materials))])
    return Materials.of_rows(np.array(list(found)))


def _voters(problem: JointProblem, point: Point, m: int) -> list[Illumination]:
    """At most ROWS fitted observations of material m in each light, so that a worker is not sent all observations."""
    voters = []
    for one in problem.illuminations(point):
        rows = np.flatnonzero((one.block.material == m) & ~one.block.held_out)
        if len(rows):
            some = rows[np.linspace(0, len(rows) - 1, min(len(rows), ROWS)).astype(int)]
            voters.append(msgspec.structs.replace(one, block=one.block.take(some)))
    return voters


def _searched(of: tuple[int, list[Illumination]], materials: Materials, loss: Loss) -> Float[np.ndarray, "7"]:
    """The row of a material of that number, as its voters have it."""
    m, voters = of
    present, trials = materials.rows()[m], []
    if not voters:
        return present
    weight = [one.block.precision * np.sqrt(loss.trust(one.residuals())) * ~one.block.clipped for one in voters]
    radiance = np.concatenate([one.block.radiance for one in voters])
    for roughness in (present[6], *GRID):
        rough = Materials(materials.diffuse, materials.specular, np.full(len(materials), roughness))
        shown = [msgspec.structs.replace(one, materials=rough).shown() for one in voters]
        unit = np.stack([np.concatenate([getattr(one, k) for one in shown]) for k in ("diffuse", "specular")], axis=-1)
        lost, kd, ks = reflectances(unit, radiance, np.concatenate(weight))
        trials.append((lost, [*kd, *ks, roughness]))
    best = min(trials, key=lambda trial: trial[0])
    return np.array(best[1]) if best[0] < BETTER * trials[0][0] else present


def reflectances(
    unit: Float[np.ndarray, "n 3 2"], radiance: Float[np.ndarray, "n 3"], weight: Float[np.ndarray, "n 3"]
) -> tuple[float, Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Loss, k_d and k_s of the non-negative least-squares fit of radiance; unit: what k_d = 1 and k_s = 1 show."""
    total, factors = 0.0, np.zeros((3, 2))
    for c in range(3):
        factors[c], residual = nnls(unit[:, c] * weight[:, c, None], radiance[:, c] * weight[:, c])
        total += residual**2
    return total, *np.maximum(factors, LEAST_REFLECTANCE).T
