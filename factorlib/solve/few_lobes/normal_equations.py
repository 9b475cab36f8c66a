"""The normal equations of one illumination, half the gradient and half the Gauss–Newton Hessian of the loss (for Σ r²: Jᵀr and JᵀJ), and
its lobes' weights given everything else: a non-negative least-squares problem per illumination and channel.

The weights are solved for on the Cholesky factor of the Gram matrix, so its size is the number of lobes, not of observations.  Clipped
channels and outliers get the weights that they have at the current residual.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import msgspec
import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.linalg import cholesky, solve_triangular
from scipy.optimize import nnls

from factorlib.elementary import product
from factorlib.model.illumination import Illumination
from factorlib.model.lights import Light
from factorlib.model.loss import Loss
from factorlib.solve.few_lobes.jacobian import (
    Responses,
    fitted,
    linearise,
    places_of,
    responses,
    tint_prior,
    whitened,
    with_light,
)
from factorlib.solve.few_lobes.unknowns import unit_energy, unknowns

KEPT = 1 << 20  # responses of observations to lobes that stay in memory; if there are more, they are computed twice


class NormalEquations(msgspec.Struct, frozen=True):
    """Gauss–Newton system of one illumination: gradient and Hessian blocks of the materials that it shows (k unknowns) and its light (l).

    places: numbers of the k unknowns among those of all materials, ascending
    scores: the gradient's part from each of g clusters of observations, where clusters were asked for
    """

    loss: float
    places: Int[np.ndarray, " k"]
    material_gradient: Float[np.ndarray, " k"]
    light_gradient: Float[np.ndarray, " l"]
    material_hessian: Float[np.ndarray, "k k"]
    cross_hessian: Float[np.ndarray, "k l"]
    light_hessian: Float[np.ndarray, "l l"]
    scores: Float[np.ndarray, "g k+l"] | None = None


def normal_equations(
    illumination: Illumination,
    loss: Loss,
    clusters: Int[np.ndarray, " n"] | None = None,
    known: Iterable[Responses] | None = None,
) -> NormalEquations:
    """The system of the observations that are not held out.

    clusters: number of each observation's cluster, from 0, for `NormalEquations.scores`
    known: responses of what is fitted to the light, where they were computed before
    """
    light, own, total = illumination.light, fitted(illumination), 0.0
    every = places_of(own)
    size, k = len(every), len(every) - unknowns(light)
    hessian, gradient = np.zeros((size, size)), np.zeros(size)
    scores = None if clusters is None else np.zeros((int(clusters.max(initial=-1)) + 1, size))
    if clusters is not None:
        clusters = clusters[~illumination.block.held_out]
    for part in linearise(own, loss, known):
        total += part.loss
        places, jacobian, residual = np.searchsorted(every, part.places), part.jacobian, part.residual
        hessian[np.ix_(places, places)] += product(jacobian.T, jacobian).numpy()
        gradient[places] += product(jacobian.T, residual).numpy()
        if scores is not None:
            np.add.at(scores, (clusters[part.rows][:, None], places[None]), (jacobian * residual[:, None]).numpy())
    prior = tint_prior(loss, own.block, light)
    gradient[k:] += prior.gradient
    hessian[k:, k:] += prior.hessian
    blocks = (hessian[:k, :k], hessian[:k, k:], hessian[k:, k:])
    return NormalEquations(total + prior.value, every[:k], gradient[:k], gradient[k:], *blocks, scores)


class EnergyEquations(NamedTuple):
    """Loss, gradient and Hessian of one illumination by the lobes' energies of each channel alone."""

    loss: float
    gradients: Float[np.ndarray, "3 p"]
    hessians: Float[np.ndarray, "3 p p"]


def energy_equations(illumination: Illumination, known: Iterable[Responses], loss: Loss) -> EnergyEquations:
    """The part of `normal_equations` by the lobes' energies, the same numbers; known: responses of all observations to the light."""
    block, light, materials = illumination.block, illumination.light, illumination.materials
    p, total = len(light), 0.0
    gradient, hessian = np.zeros((3, p)), np.zeros((3, p, p))
    per_energy = torch.from_numpy(unit_energy(light))
    for some in known:
        for c in range(3):
            seen = whitened(block, some.rows, c, some.linear(block, light, materials, c), loss)
            scaled = some.basis(materials, c) / per_energy * seen.scale[:, None]
            hessian[c] += product(scaled.T, scaled).numpy()
            gradient[c] += product(scaled.T, seen.residual).numpy()
            total += seen.loss
    prior = tint_prior(loss, block, light)
    for c in range(3):
        own = slice((3 + c) * p, (4 + c) * p)
        gradient[c] += prior.gradient[own]
        hessian[c] += prior.hessian[own, own]
    return EnergyEquations(total + prior.value, gradient, hessian)


class Fitted(NamedTuple):
    """A light with fitted weights, and the normal equations there."""

    light: Light
    equations: NormalEquations


def with_weights_fitted(illumination: Illumination, loss: Loss) -> Fitted:
    """The light with the weights that lower the loss most, while nothing else changes.

    With clipped observations or outliers the loss is not quadratic in the weights.  If the fitted weights would raise the loss, the
    light keeps its own.
    """
    own = fitted(illumination)
    computed = responses(own)
    kept = list(computed) if len(own.block) * len(own.light) <= KEPT else None
    before = energy_equations(own, computed if kept is None else kept, loss)
    other = with_light(own, of_least_loss(own.light, before))
    after = normal_equations(other, loss, known=kept)
    if after.loss <= before.loss:
        return Fitted(other.light, after)
    return Fitted(own.light, normal_equations(own, loss, known=kept))


def of_least_loss(light: Light, equations: EnergyEquations) -> Light:
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
