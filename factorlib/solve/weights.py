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

from factorlib.solve.normal_equations import System
from factorlib.solve.unknowns import Light


def refitted_weights(light: Light, equations: System) -> Light:
    """The non-negative weights that minimise the quadratic model of `equations` with all else held."""
    p = len(light)
    energy = light.energy
    for c in range(3):
        own = slice((3 + c) * p, (4 + c) * p)
        hessian = equations.light_hessian[own, own]
        target = hessian @ energy[:, c] - equations.light_gradient[own]
        energy[:, c] = nonnegative_minimum(hessian, target)
    return msgspec.structs.replace(light, weight=energy / light.spread[:, None])


def nonnegative_minimum(hessian: Float[np.ndarray, "p p"], target: Float[np.ndarray, "p"]) -> Float[np.ndarray, "p"]:
    """argmin over w ≥ 0 of ½ wᵀHw − tᵀw, H made definite by 1e-9 of its mean diagonal."""
    scale = np.sqrt(np.maximum(np.diag(hessian), 1e-12 * max(float(np.diag(hessian).max()), 1e-30)))
    normalised = hessian / np.outer(scale, scale) + 1e-9 * np.eye(len(scale))
    upper = cholesky(normalised)
    right = solve_triangular(upper, target / scale, trans="T")
    return nnls(upper, right, maxiter=50 * len(scale))[0] / scale
