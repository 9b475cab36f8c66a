"""The light that one photo asks for, given materials and normals: found anew for every pose, so that none is favoured.

The light of the solve was fitted to the pose that is in question.  Here lobes are pursued from nothing over the dictionary of
`factorlib.solve.insertion`, which no pose has had a say in, and their weights are a non-negative least-squares problem.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from factorlib.solve.insertion import lobes_inserted, pruned, whitened_atoms
from factorlib.solve.normal_equations import predicted_radiance, residuals
from factorlib.solve.problem import Block, of_rows
from factorlib.solve.start import starting_light
from factorlib.solve.unknowns import Light, Materials
from factorlib.solve.weights import nonnegative_minimum

ROUNDS, INSERTED = 3, 16  # of pursuit, and lobes in each
REWEIGHTED = 3  # times, for outliers
RIDGE = 1e-4  # of the squared response of each lobe


def pursued_light(block: Block, materials: Materials, operator) -> Light:
    """Explains what of the block is not held out."""
    block = of_rows(block, ~block.held_out)
    light = starting_light(block, materials)
    for number in range(ROUNDS):
        light = lobes_inserted(block, light, materials, operator, INSERTED, number)
        light = pruned(with_weights(block, light, materials, operator))
    return light


def together(lights: Sequence[Light]) -> Light:
    """All their lobes: candidates that choose weights of the same lobes differ by nothing else."""
    parts = [np.concatenate([getattr(light, name) for light in lights]) for name in ("axis", "log_sharpness", "weight")]
    return Light(*parts, lights[0].log_exposure)


def with_weights(block: Block, light: Light, materials: Materials, operator) -> Light:
    """The light with the weights ≥ 0 that explain best, robustly, what is not held out."""
    rows = np.flatnonzero(~block.held_out)
    atoms = whitened_atoms(block, rows, materials, operator, light.axis, light.sharpness, light)
    target = block.radiance[rows] * block.precision[rows]
    weight = light.weight.copy()
    for _ in range(REWEIGHTED):
        residual = np.einsum("cnp,pc->nc", atoms, weight) - target
        trust = 1 / np.sqrt(1 + (residual / robust_scale(residual)) ** 2)
        for c in range(3):
            weighted = atoms[c] * trust[:, c, None]
            weight[:, c] = nonnegative_minimum(weighted.T @ atoms[c] + _ridge(atoms[c]), weighted.T @ target[:, c])
    return Light(light.axis, light.log_sharpness, weight, light.log_exposure)


def _ridge(atoms: Float[np.ndarray, "n p"]) -> Float[np.ndarray, "p p"]:
    """Keeps lobes that look alike from taking turns."""
    return RIDGE * np.diag(np.sum(atoms**2, axis=0))


def robust_scale(residual: Float[np.ndarray, "n 3"]) -> float:
    """Three robust standard deviations, never below one σ of the noise model; channels that are not compared are exactly 0."""
    told = np.abs(residual[residual != 0])
    return max(3 * 1.4826 * float(np.median(told)), 1.0) if len(told) else 1.0


def whitened_residuals(block: Block, light: Light, materials: Materials, operator) -> Float[np.ndarray, "n 3"]:
    return residuals(block, predicted_radiance(block, light, materials, operator))
