"""Lobe weights given everything else: a non-negative least-squares problem per illumination and channel.

Solved on the Cholesky factor of the Gram matrix, so its size is the number of lobes, not of observations; clipped
channels that are already explained, and outliers, carry the weights of the current residual.
"""

from __future__ import annotations

import msgspec
import numpy as np
from jaxtyping import Float
from scipy.linalg import cholesky, solve_triangular
from scipy.optimize import nnls

from factorlib.solve.normal_equations import Loss, System, energy_systems, responses, system
from factorlib.solve.problem import Block, not_held_out
from factorlib.solve.unknowns import Light, Materials

HELD = 1 << 20  # responses of observations to lobes that are held; of more they are computed twice


def system_of_fitted(block: Block, light: Light, materials: Materials, operator, loss: Loss) -> tuple[Light, System]:
    """The light with the weights that lower the loss most, all else held, and its system.

    Observations that are clipped, outliers or toned make the loss one of more than least squares: a light whose fitted weights
    would raise it keeps its own.
    """
    block = not_held_out(block)
    shown = responses(block, light, materials, operator)
    held = list(shown) if len(block) * len(light) <= HELD else None
    before, gradients, hessians = energy_systems(block, light, materials, shown if held is None else held, loss)
    found = with_fitted_weights(light, gradients, hessians)
    of_found = system(block, found, materials, operator, loss, shown=held)
    return (found, of_found) if of_found.loss <= before else (light, system(block, light, materials, operator, loss, shown=held))


def with_fitted_weights(light: Light, gradients: Float[np.ndarray, "3 p"], hessians: Float[np.ndarray, "3 p p"]) -> Light:
    """The non-negative weights that minimise the quadratic model, by the energies of each channel, with all else held."""
    energy = light.energy
    for c, (gradient, hessian) in enumerate(zip(gradients, hessians, strict=True)):
        energy[:, c] = nonnegative_minimum(hessian, hessian @ energy[:, c] - gradient)
    return msgspec.structs.replace(light, weight=energy / light.spread[:, None])


def nonnegative_minimum(hessian: Float[np.ndarray, "p p"], target: Float[np.ndarray, "p"]) -> Float[np.ndarray, "p"]:
    """argmin over w ≥ 0 of ½ wᵀHw − tᵀw, H made definite by 1e-9 of its mean diagonal."""
    scale = np.sqrt(np.maximum(np.diag(hessian), 1e-12 * max(float(np.diag(hessian).max()), 1e-30)))
    normalised = hessian / np.outer(scale, scale) + 1e-9 * np.eye(len(scale))
    upper = cholesky(normalised)
    right = solve_triangular(upper, target / scale, trans="T")
    return nnls(upper, right, maxiter=50 * len(scale))[0] / scale
