"""Normal equations of arrow shape: each light is coupled to the materials it illuminates, and to no other light.

H = [[M, C_1 … C_k], [C_iᵀ, L_i]] has materials M and one block L_i a light; the gradients are g_m and g_i.  Eliminating
every light leaves

    (M − Σ C_i L_i⁻¹ C_iᵀ) dm = −(g_m − Σ C_i L_i⁻¹ (g_i + d_i)),      dl_i = −L_i⁻¹ (g_i + C_iᵀ dm)               (1)

d_i is a gradient with respect to the light that acts on the materials only (`factorlib.inference.likelihood`).  The
Schur complement on the left is the information of the data about the materials with the lights unknown too.  C_i has
rows only for the materials that light i illuminates, so the cost grows with those few.

`Arrow` is H factorised, the metric of the optimiser's steps.  Rows and columns of known unknowns and of unknowns at a
bound are removed.  Damping multiplies the diagonal, so that a step does not depend on the units of an unknown.
`information` is the Schur complement alone, the source of the standard errors.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.linalg import cho_factor, cho_solve

FLOOR = 1e-9  # share of the largest diagonal entry that is added to every diagonal entry
Vector = Float[np.ndarray, " k"]
Matrix = Float[np.ndarray, "k k"]


class System(NamedTuple):
    """Contribution of one illumination to the objective, half its gradient and half its Gauss–Newton Hessian.

    The k unknowns of the materials are those the block shows; the light has l unknowns.

    Attributes:
        value: Contribution to the objective.
        loss: Sum of the robust losses in `value`.
        places: Indices of the block's material unknowns, ascending.
        material_gradient: g_m.
        material_hessian: M.
        light_gradient: g_i.
        cross_hessian: C_i.
        light_hessian: L_i.
        factor: Lower Cholesky factor of L_i.
        determinant_by_materials: Half the gradient of log det H with respect to materials.
        determinant_hessian: Half its Hessian with respect to materials.
        determinant_by_light: d_i of (1).
        scores: Contributions to the gradient, materials then light, one row a cluster of observations; None if not
            requested.
    """

    value: float
    loss: float
    places: Int[np.ndarray, " k"]
    material_gradient: Float[np.ndarray, " k"]
    material_hessian: Float[np.ndarray, "k k"]
    light_gradient: Float[np.ndarray, " l"]
    cross_hessian: Float[np.ndarray, "k l"]
    light_hessian: Float[np.ndarray, "l l"]
    factor: Float[np.ndarray, "l l"]
    determinant_by_materials: Float[np.ndarray, " k"]
    determinant_hessian: Float[np.ndarray, "k k"]
    determinant_by_light: Float[np.ndarray, " l"]
    scores: Float[np.ndarray, "g k+l"] | None = None


class Arrow:
    """Factorised H of many lights; H⁻¹ of a vector costs two triangular solves a light.

    Args:
        systems: Contribution of each light.
        prior: Half the Hessian of the prior on materials.
        free: Mask of the material unknowns that may move.
        damping: Multiple of the materials' diagonal that is added to it.
    """

    def __init__(self, systems: Sequence[System], prior: Matrix, free: Bool[np.ndarray, " k"], damping: float = 0.0):
        self.systems = systems
        self.free = np.flatnonzero(free)
        self.coupling = [solve_cholesky(part.factor, part.cross_hessian.T) for part in systems]  # L⁻¹Cᵀ
        # M − Σ C_i L_i⁻¹ C_iᵀ, (1), damped
        schur = prior.copy()
        for part, coupling in zip(systems, self.coupling, strict=True):
            schur[np.ix_(part.places, part.places)] += part.material_hessian - part.cross_hessian @ coupling
        self.diagonal = np.diag(prior) + self._material_diagonal(len(prior))
        schur += np.diag(damping * self.diagonal + FLOOR * self.diagonal.max(initial=1e-30))
        self.schur = cho_factor(((schur + schur.T) / 2)[np.ix_(self.free, self.free)], check_finite=False)

    def _material_diagonal(self, size: int) -> Vector:
        """Return the diagonal of the sum of the lights' material Hessians."""
        diagonal = np.zeros(size)
        for part in self.systems:
            diagonal[part.places] += np.diag(part.material_hessian)
        return diagonal

    def solve(self, by_materials: Vector, by_lights: Sequence[Vector]) -> tuple[Vector, list[Vector]]:
        """Return H⁻¹ g, by (1)."""
        # L_i⁻¹ g_i, then dm by the Schur complement, then L_i⁻¹ (g_i − C_iᵀ dm)
        alone = [solve_cholesky(part.factor, g) for part, g in zip(self.systems, by_lights, strict=True)]
        reduced = by_materials.copy()
        step = np.zeros_like(by_materials)
        for part, own in zip(self.systems, alone, strict=True):
            reduced[part.places] -= part.cross_hessian @ own
        step[self.free] = cho_solve(self.schur, reduced[self.free], check_finite=False)
        lights = zip(self.systems, alone, self.coupling, strict=True)
        return step, [own - coupling @ step[part.places] for part, own, coupling in lights]


def solve_cholesky(factor: Float[np.ndarray, "l l"], right: Float[np.ndarray, "l ..."]) -> Float[np.ndarray, "l ..."]:
    """Return L⁻¹ of a vector or of columns, L given by its lower Cholesky factor."""
    return cho_solve((factor, True), right, check_finite=False)


def information(systems: Sequence[System], size: int) -> tuple[Matrix, list[Float[np.ndarray, "g k"]]]:
    """Return the Schur complement of (1), and the scores of clusters with the lights eliminated.

    Args:
        systems: Contribution of each light.
        size: Number of material unknowns.

    Returns:
        The left side of (1) [size, size], and for each light with scores their values [g, size] less the part that the
        light absorbs.
    """
    hessian = np.zeros((size, size))
    scores = []
    for part in systems:
        coupling = solve_cholesky(part.factor, part.cross_hessian.T)
        # Σ M − C_i L_i⁻¹ C_iᵀ
        hessian[np.ix_(part.places, part.places)] += part.material_hessian - part.cross_hessian @ coupling
        if part.scores is not None:
            k = len(part.places)
            scores.append(np.zeros((len(part.scores), size)))
            # s_m − s_l L_i⁻¹ C_iᵀ
            scores[-1][:, part.places] = part.scores[:, :k] - part.scores[:, k:] @ coupling
    return (hessian + hessian.T) / 2, scores
