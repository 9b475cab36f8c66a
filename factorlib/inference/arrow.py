"""Normal equations of arrow shape: each light is linked to the materials that it shows, and to no other light.

With H = [[M, C_1 … C_k], [C_iᵀ, L_i]] (materials M, one block L_i a light) and gradients g_m, g_i, eliminating every light leaves

    (M − Σ C_i L_i⁻¹ C_iᵀ) dm = −(g_m − Σ C_i L_i⁻¹ (g_i + d_i)),      dl_i = −L_i⁻¹ (g_i + C_iᵀ dm)                (1)

where d_i is a gradient by the light that materials alone feel (`factorlib.inference.likelihood`).  The Schur complement on the left is the information
that the data hold about the materials when the lights are unknown too.  A light's C has rows for the materials that it shows alone, so that cost
grows with those few.

A step is the elimination of damped systems; standard errors come of that of the systems as they are.  Unknowns that are known or at a bound have their
rows and columns taken out before.  Damping multiplies the diagonal, so that a step does not depend on the units of an unknown.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import cho_factor, cho_solve

FLOOR = 1e-9  # damping never sees a smaller diagonal entry than this share of the largest
Vector, Matrix = Float[np.ndarray, " k"], Float[np.ndarray, "k k"]


class System(NamedTuple):
    """One illumination's part of a value that is minimised, half its gradient and half its Gauss–Newton Hessian.

    value    of which `loss` is the sum of the robust losses
    places   numbers of the k unknowns of the materials that the block shows, ascending;  the light has l unknowns
    determinant_by_light   d of (1)
    scores   the parts of the gradient by materials and light, one a cluster of observations, where clusters were asked for
    """

    value: float
    loss: float
    places: Int[np.ndarray, " k"]
    material_gradient: Float[np.ndarray, " k"]
    material_hessian: Float[np.ndarray, "k k"]
    light_gradient: Float[np.ndarray, " l"]
    cross_hessian: Float[np.ndarray, "k l"]
    light_hessian: Float[np.ndarray, "l l"]
    determinant_by_light: Float[np.ndarray, " l"]
    scores: Float[np.ndarray, "g k+l"] | None = None


def summed(systems: Sequence[System], hessian: Matrix, gradient: Vector) -> tuple[Matrix, Vector]:
    """M and g_m: those given, which are of the prior on materials, and the parts of all lights."""
    hessian, gradient = hessian.copy(), gradient.copy()
    for part in systems:
        hessian[np.ix_(part.places, part.places)] += part.material_hessian
        gradient[part.places] += part.material_gradient
    return hessian, gradient


def eliminate(systems: Sequence[System], hessian: Matrix, gradient: Vector) -> list[Float[np.ndarray, "l k+2"]]:
    """Take the lights out of M and g_m, in place; returns L⁻¹ [Cᵀ, g, d] of each light."""
    solutions = []
    for part in systems:
        C = part.cross_hessian
        right = np.column_stack([C.T, part.light_gradient, part.determinant_by_light])
        factor = cho_factor(part.light_hessian, check_finite=False)
        solutions.append(solution := cho_solve(factor, right, check_finite=False))
        hessian[np.ix_(part.places, part.places)] -= C @ solution[:, :-2]
        gradient[part.places] -= C @ (solution[:, -2] + solution[:, -1])
    return solutions


def information(systems: Sequence[System], size: int) -> tuple[Matrix, list[Float[np.ndarray, "g k"]]]:
    """The left side of (1) for `size` unknowns of materials, and the scores of each light's clusters, where there are
    any, less what the light takes up of them."""
    hessian, gradient = summed(systems, np.zeros((size, size)), np.zeros(size))
    scores = []
    for part, solution in zip(systems, eliminate(systems, hessian, gradient), strict=True):
        if part.scores is not None:
            k = len(part.places)
            scores.append(np.zeros((len(part.scores), size)))
            scores[-1][:, part.places] = part.scores[:, :k] - part.scores[:, k:] @ solution[:, :k]
    return (hessian + hessian.T) / 2, scores


def damped(hessian: Matrix, damping: float) -> Matrix:
    """Return the matrix with its diagonal made 1 + damping times as large, and positive."""
    diagonal = np.diag(hessian)
    floor = FLOOR * max(float(diagonal.max(initial=0.0)), 1e-30)
    return hessian + np.diag(damping * np.maximum(diagonal, floor) + floor)
