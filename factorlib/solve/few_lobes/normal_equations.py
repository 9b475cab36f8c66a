"""The normal equations of one illumination: half the gradient and half the Gauss–Newton Hessian of the loss (for Σ r²: Jᵀr and JᵀJ)."""

from __future__ import annotations

from collections.abc import Iterable

import msgspec
import numpy as np
import torch
from jaxtyping import Float, Int

from factorlib.elementary import product
from factorlib.model.illumination import Illumination
from factorlib.model.loss import Loss
from factorlib.solve.few_lobes.jacobian import fitted, linearise, places_of, whitened
from factorlib.solve.few_lobes.responses import Responses, bounced_of
from factorlib.solve.few_lobes.tint import tint_prior
from factorlib.solve.few_lobes.unknowns import unit_energy, unknowns


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


class EnergyEquations(msgspec.Struct, frozen=True):
    """Loss, gradient and Hessian of one illumination by the lobes' energies of each channel alone."""

    loss: float
    gradients: Float[np.ndarray, "3 p"]
    hessians: Float[np.ndarray, "3 p p"]


def energy_equations(illumination: Illumination, known: Iterable[Responses], loss: Loss) -> EnergyEquations:
    """The part of `normal_equations` by the lobes' energies, the same numbers; known: responses of all observations to the light."""
    block, light, materials = illumination.block, illumination.light, illumination.materials
    p, total = len(light), 0.0
    gradient, hessian = np.zeros((3, p)), np.zeros((3, p, p))
    weight, per_energy = torch.from_numpy(light.weight), torch.from_numpy(unit_energy(light))
    for some in known:
        for c in range(3):
            basis = some.basis(materials, c)
            linear = product(basis, weight[:, c])
            if block.bounced is not None:
                linear = linear + torch.from_numpy(bounced_of(block, some.rows, materials, some.material)[:, c])
            seen = whitened(block, light, some.rows, c, linear, loss)
            scaled = basis / per_energy * (seen.rising * seen.scale[:, None])
            hessian[c] += product(scaled.T, scaled).numpy()
            gradient[c] += product(scaled.T, seen.residual).numpy()
            total += seen.loss
    prior = tint_prior(loss, block, light)
    for c in range(3):
        own = slice((3 + c) * p, (4 + c) * p)
        gradient[c] += prior.gradient[own]
        hessian[c] += prior.hessian[own, own]
    return EnergyEquations(total + prior.value, gradient, hessian)
