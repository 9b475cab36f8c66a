"""Lobe weights given everything else: a non-negative least-squares problem per illumination and channel.

It is solved on the Cholesky factor of the Gram matrix, so its size is the number of lobes, not of observations.  Clipped channels and
outliers get the weights that they have at the current residual.
"""

from __future__ import annotations

from typing import NamedTuple

import msgspec
import numpy as np
from jaxtyping import Float
from scipy.linalg import cholesky, solve_triangular
from scipy.optimize import nnls

from factorlib.model.illumination import Illumination
from factorlib.model.lights import Light
from factorlib.model.loss import Loss
from factorlib.solve.few_lobes.jacobian import fitted, with_light
from factorlib.solve.few_lobes.normal_equations import (
    EnergyEquations,
    NormalEquations,
    energy_equations,
    normal_equations,
)
from factorlib.solve.few_lobes.responses import responses
from factorlib.solve.few_lobes.unknowns import unit_energy

KEPT = 1 << 20  # responses of observations to lobes that stay in memory; if there are more, they are computed twice


class Fitted(NamedTuple):
    """A light with fitted weights, and the normal equations there."""

    light: Light
    equations: NormalEquations


def fitted_illumination(illumination: Illumination, loss: Loss) -> Fitted:
    """The light with the weights that lower the loss most, while nothing else changes.

    With clipped observations, outliers or tone curves the loss is not quadratic in the weights.  If the fitted weights would raise the
    loss, the light keeps its own.
    """
    own = fitted(illumination)
    computed = responses(own)
    kept = list(computed) if len(own.block) * len(own.light) <= KEPT else None
    before = energy_equations(own, computed if kept is None else kept, loss)
    found = with_light(own, with_fitted_weights(own.light, before))
    after = normal_equations(found, loss, known=kept)
    return (
        Fitted(found.light, after)
        if after.loss <= before.loss
        else Fitted(own.light, normal_equations(own, loss, known=kept))
    )


def with_fitted_weights(light: Light, equations: EnergyEquations) -> Light:
    """The non-negative weights that minimise the quadratic model by the energies of each channel, all else as it is."""
    energy = light.energy
    for c, (gradient, hessian) in enumerate(zip(equations.gradients, equations.hessians, strict=True)):
        energy[:, c] = nonnegative_minimum(hessian, hessian @ energy[:, c] - gradient)
    return msgspec.structs.replace(light, weight=energy / unit_energy(light)[:, None])


def nonnegative_minimum(hessian: Float[np.ndarray, "p p"], target: Float[np.ndarray, " p"]) -> Float[np.ndarray, " p"]:
    """argmin over w ≥ 0 of ½ wᵀHw − tᵀw, H made definite by 1e-9 of its mean diagonal."""
    scale = np.sqrt(np.maximum(np.diag(hessian), 1e-12 * max(float(np.diag(hessian).max()), 1e-30)))
    normalised = hessian / np.outer(scale, scale) + 1e-9 * np.eye(len(scale))
    upper = cholesky(normalised)
    right = solve_triangular(upper, target / scale, trans="T")
    return nnls(upper, right, maxiter=50 * len(scale))[0] / scale
