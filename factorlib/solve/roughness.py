"""A roughness that stands in a wrong valley, found by a search over all of them, the lights held.

Given the lights, radiance is linear in k_d and k_s, and only roughness is not: for each of `GRID` the two are solved for per
channel (non-negative least squares), which leaves a curve of one variable for each material.  Its minimum replaces the
material where it lies far enough below the loss of the present roughness, solved in the same way.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
import torch
from jaxtyping import Float
from scipy.optimize import nnls

from factorlib.solve.normal_equations import Loss, operator_inputs, predicted_radiance, residuals, robust_loss
from factorlib.solve.problem import Block, of_rows
from factorlib.solve.shadowing import shadowed
from factorlib.solve.tone import slope_at, straightened
from factorlib.solve.unknowns import LEAST_REFLECTANCE, Light, Materials

GRID = (0.1, 0.14, 0.19, 0.26, 0.35, 0.46, 0.6, 0.78, 1.0)
ROWS = 300  # observations of each material in each light that vote
BETTER = 0.95  # of the present loss


def materials_out_of_valleys(
    blocks: Sequence[Block], materials: Materials, lights: Sequence[Light], operator, loss: Loss, map_: Callable
) -> Materials:
    """The materials, those replaced for which another roughness explains the sampled observations better."""
    searched = partial(_searched, materials=materials, lights=lights, operator=operator, loss=loss)
    voters = [[_voters(block, m) for block in blocks] for m in range(len(materials))]  # so that no worker is handed all observations
    found = list(map_(searched, list(enumerate(voters))))
    diffuse, specular, roughness = (np.array(values) for values in zip(*found, strict=True))
    return Materials(diffuse, specular, roughness)


def _searched(of: tuple[int, list[Block]], materials: Materials, lights: Sequence[Light], operator, loss: Loss):
    m, blocks = of
    present = materials.diffuse[m], materials.specular[m], float(materials.roughness[m])
    pairs = [(voters, light) for voters, light in zip(blocks, lights, strict=True) if len(voters)]
    if not pairs:
        return present
    weight = np.concatenate([_weight(voters, light, materials, operator, loss) for voters, light in pairs])
    radiance = np.concatenate([straightened(voters.radiance, light, voters.photo) for voters, light in pairs])
    trials = []
    for roughness in (present[2], *GRID):
        diffuse, specular = (np.concatenate(part) for part in zip(*(_lit(*pair, roughness, operator) for pair in pairs), strict=True))
        trials.append((*reflectances(diffuse, specular, radiance, weight), roughness))
    best = min(trials, key=lambda trial: trial[0])
    return best[1:] if best[0] < BETTER * trials[0][0] else present


def _voters(block: Block, m: int) -> Block:
    rows = np.flatnonzero((block.material == m) & ~block.held_out)
    return of_rows(block, rows[np.linspace(0, len(rows) - 1, min(len(rows), ROWS)).astype(int)])


def _weight(voters: Block, light: Light, materials: Materials, operator, loss: Loss) -> Float[np.ndarray, "n 3"]:
    """Roots of weights of linear radiance: outliers of the present model count little, clipped channels not at all."""
    _, robust = robust_loss(residuals(voters, predicted_radiance(voters, light, materials, operator)), loss.robust_scale)
    precision = voters.precision * slope_at(voters.radiance, light, voters.photo)
    return np.where(voters.clipped, 0.0, precision * np.sqrt(robust))


def _lit(voters: Block, light: Light, roughness: float, operator) -> tuple[np.ndarray, np.ndarray]:
    """Radiance [n, 3] of unit k_d and of unit k_s."""
    rows = slice(0, len(voters))
    inputs = operator_inputs(voters, rows, light.axis, light.sharpness, roughness, operator)
    with torch.no_grad():
        parts = operator.diffuse(inputs[1], inputs[3]), operator.specular(*inputs)
        parts = shadowed(parts, voters, rows, light.axis, light.sharpness, roughness)
    exposure = np.exp(light.log_exposure)[voters.photo, None]
    diffuse, specular = (exposure * (part.double().numpy() @ light.weight) for part in parts)
    return diffuse, specular


def reflectances(diffuse, specular, radiance, weight) -> tuple[float, Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Loss, k_d and k_s of the non-negative least-squares fit of radiance [n, 3] by k_d · diffuse + k_s · specular."""
    total, factors = 0.0, np.zeros((3, 2))
    for c in range(3):
        factors[c], residual = nnls(np.column_stack([diffuse[:, c], specular[:, c]]) * weight[:, c, None], radiance[:, c] * weight[:, c])
        total += residual**2
    factors = np.maximum(factors, LEAST_REFLECTANCE)
    return total, factors[:, 0], factors[:, 1]
