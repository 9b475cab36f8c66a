"""Normal equations of arrow shape: each light is linked to the materials that it shows, and to no other light.

With H = [[M, C_1 … C_k], [C_iᵀ, L_i]] (materials M, one block L_i a light) and gradients g_m, g_i, eliminating every light leaves

    (M − Σ C_i L_i⁻¹ C_iᵀ) dm = −(g_m − Σ C_i L_i⁻¹ (g_i + d_i)),      dl_i = −L_i⁻¹ (g_i + C_iᵀ dm)                (1)

where d_i is a gradient by the light that materials alone feel (`factorlib.inference.likelihood`).  The Schur complement on the left is the information
that the data hold about the materials when the lights are unknown too.  A light's C has rows for the materials that it shows alone, so that cost
grows with those few.

`Arrow` is H factorised: the metric in which the optimiser steps.  Unknowns that are known or at a bound have their rows and columns taken out.
Damping multiplies the diagonal, so that a step does not depend on the units of an unknown.  `information` is the Schur complement alone, of which
standard errors come.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.linalg import cho_factor, cho_solve

FLOOR = 1e-9  # share of the largest diagonal entry that is added to all
Vector = Float[np.ndarray, " k"]
Matrix = Float[np.ndarray, "k k"]


class System(NamedTuple):
    """One illumination's part of a value that is minimised, half its gradient and half its Gauss–Newton Hessian.

    value    of which `loss` is the sum of the robust losses
    places   numbers of the k unknowns of the materials that the block shows, ascending;  the light has l unknowns
    factor   lower Cholesky factor of light_hessian
    determinant_by_materials, determinant_hessian, determinant_by_light   of log det H: by materials, and d of (1)
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
    factor: Float[np.ndarray, "l l"]
    determinant_by_materials: Float[np.ndarray, " k"]
    determinant_hessian: Float[np.ndarray, "k k"]
    determinant_by_light: Float[np.ndarray, " l"]
    scores: Float[np.ndarray, "g k+l"] | None = None


class Arrow:
    """H of many lights factorised, so that H⁻¹ of any vector costs two triangular solves a light.

    prior, free: Hessian of the prior on materials, and which of their unknowns may move;  damping: of the materials' diagonal
    """

    def __init__(self, systems: Sequence[System], prior: Matrix, free: Bool[np.ndarray, " k"], damping: float = 0.0):
        self.systems = systems
        self.free = np.flatnonzero(free)
        self.coupling = [solved(part.factor, part.cross_hessian.T) for part in systems]  # L⁻¹Cᵀ
        schur = prior.copy()
        for part, coupling in zip(systems, self.coupling, strict=True):
            schur[np.ix_(part.places, part.places)] += part.material_hessian - part.cross_hessian @ coupling
        self.diagonal = np.diag(prior) + self._material_diagonal(len(prior))
        schur += np.diag(damping * self.diagonal + FLOOR * self.diagonal.max(initial=1e-30))
        self.schur = cho_factor(((schur + schur.T) / 2)[np.ix_(self.free, self.free)], check_finite=False)

    def _material_diagonal(self, size: int) -> Vector:
        diagonal = np.zeros(size)
        for part in self.systems:
            diagonal[part.places] += np.diag(part.material_hessian)
        return diagonal

    def solve(self, by_materials: Vector, by_lights: Sequence[Vector]) -> tuple[Vector, list[Vector]]:
        """Return H⁻¹ g, by (1)."""
        alone = [solved(part.factor, g) for part, g in zip(self.systems, by_lights, strict=True)]
        reduced = by_materials.copy()
        step = np.zeros_like(by_materials)
        for part, own in zip(self.systems, alone, strict=True):
            reduced[part.places] -= part.cross_hessian @ own
        step[self.free] = cho_solve(self.schur, reduced[self.free], check_finite=False)
        lights = zip(self.systems, alone, self.coupling, strict=True)
        return step, [own - coupling @ step[part.places] for part, own, coupling in lights]


def solved(factor: Float[np.ndarray, "l l"], right: Float[np.ndarray, "l ..."]) -> Float[np.ndarray, "l ..."]:
    """Return L⁻¹ of a vector or of columns, L given by its lower Cholesky factor."""
    return cho_solve((factor, True), right, check_finite=False)


def information(systems: Sequence[System], size: int) -> tuple[Matrix, list[Float[np.ndarray, "g k"]]]:
    """Return the left side of (1) for `size` unknowns of materials, and the scores of each light's clusters, where there are
    any, less what the light takes up of them."""
    hessian = np.zeros((size, size))
    scores = []
    for part in systems:
        coupling = solved(part.factor, part.cross_hessian.T)
        hessian[np.ix_(part.places, part.places)] += part.material_hessian - part.cross_hessian @ coupling
        if part.scores is not None:
            k = len(part.places)
            scores.append(np.zeros((len(part.scores), size)))
            scores[-1][:, part.places] = part.scores[:, :k] - part.scores[:, k:] @ coupling
    return (hessian + hessian.T) / 2, scores
