"""Standard errors of the materials, from the Schur-complemented normal equations in a fixed gauge.

The data leave one factor per channel and component free, so an error is only defined once that factor is fixed.
Here the sum of diffuse and specular reflectance over a component's materials is held in each channel: with g the
direction of that factor and h the gradient of the held sum, covariances are projected by P = I − g hᵀ / (hᵀ g).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from factorlib.solve.normal_equations import predicted_radiance, residuals
from factorlib.solve.problem import Block, connected_components
from factorlib.solve.step import schur_complement
from factorlib.solve.unknowns import Light, Materials

GAUGE = "standard errors hold the sum of diffuse + specular over a component's materials fixed in each channel"
CONDITION = 1e-10  # smaller eigenvalues of the scaled information are directions the data do not see


def standard_errors(blocks: Sequence[Block], solution, operator) -> tuple[Materials, float]:
    """Standard error of every material unknown, and the residual's standard deviation in units of the noise model.

    solution: a `descent.Solution`, whose systems hold the normal equations
    """
    materials = solution.materials
    sigma = residual_deviation(blocks, materials, solution.lights, operator)
    covariance = _pseudo_inverse(schur_complement(solution.systems, materials, solution.lights)) * sigma**2
    for members, _ in connected_components(blocks, len(materials)):
        for channel in range(3):
            project = _gauge_projection(materials, members, channel)
            covariance = project @ covariance @ project.T
    errors = np.sqrt(np.maximum(np.diag(covariance), 0)).reshape(-1, 7)
    return Materials(errors[:, :3], errors[:, 3:6], errors[:, 6]), sigma


def residual_deviation(blocks: Sequence[Block], materials: Materials, lights: Sequence[Light], operator) -> float:
    """Robust standard deviation of the whitened residuals."""
    every = [residuals(b, predicted_radiance(b, light, materials, operator)) for b, light in zip(blocks, lights, strict=True)]
    return 1.4826 * float(np.median(np.abs(np.concatenate(every))))


def _gauge_projection(materials: Materials, members: Sequence[int], channel: int) -> Float[np.ndarray, "7m 7m"]:
    direction, held = np.zeros(7 * len(materials)), np.zeros(7 * len(materials))
    for m in members:
        direction[7 * m + channel], direction[7 * m + 3 + channel] = materials.diffuse[m, channel], materials.specular[m, channel]
        held[[7 * m + channel, 7 * m + 3 + channel]] = 1
    return np.eye(len(direction)) - np.outer(direction, held) / (held @ direction)


def _pseudo_inverse(information: Float[np.ndarray, "k k"]) -> Float[np.ndarray, "k k"]:
    diagonal = np.sqrt(np.maximum(np.diag(information), 1e-300))
    values, vectors = np.linalg.eigh(information / np.outer(diagonal, diagonal))
    inverse = np.where(values > CONDITION, 1 / np.maximum(values, CONDITION), 0.0)
    return (vectors * inverse) @ vectors.T / np.outer(diagonal, diagonal)
