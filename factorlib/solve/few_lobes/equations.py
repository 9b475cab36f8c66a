"""One light of few lobes at a point: derivatives, normal equations, and its lobes' weights given everything else.

Radiance is that of the one forward model, whose table is here the operator itself, with its derivatives.  Channels share the unknowns of geometry
(axis, sharpness) and have their own weights, so the Jacobian is one dense block [n, 4p + …] per channel.  Shadows multiply responses and their
derivatives; that they change as a lobe turns is left out of the Jacobian, for a step is taken only if it lowers the loss itself.

The weights are a non-negative least-squares problem per channel.  They are solved for on the Cholesky factor of the Gram matrix, so its size is the
number of lobes, not of observations.  Clipped channels and outliers get the weights that they have at the current residual.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import msgspec
import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.linalg import cholesky, solve_triangular
from scipy.optimize import nnls

from factorlib.model.blocks import Block
from factorlib.model.illumination import Illumination, material_slices
from factorlib.model.lights import Light
from factorlib.model.materials import Materials
from factorlib.model.noise import Loss
from factorlib.model.responses import Reflected, met_cosines, shadowed
from factorlib.solve.arrow import System
from factorlib.solve.few_lobes.unknowns import sharpness_slopes, tangents, unknowns

KEPT = 1 << 20  # responses of observations to lobes that stay in memory; if there are more, they are computed twice


class Responses(NamedTuple):
    """A table of one material alone, exact at its roughness: the fields of the operator's Response [n, p], with shadows."""

    parts: dict[str, Float[np.ndarray, "n p"]]

    def rows(self, m: int) -> slice:
        """All of them."""
        return slice(None)

    def at(self, m: int, roughness: float) -> Reflected:
        """The responses as they are."""
        return Reflected(*(self.parts[name] for name in ("diffuse", "specular", "specular_by_roughness")))

    def basis(self, materials: Materials, m: int, c: int) -> Float[np.ndarray, "n p"]:
        """Linear radiance of material m in channel c by the lobes' weights there, at exposure 1."""
        return materials.diffuse[m, c] * self.parts["diffuse"] + materials.specular[m, c] * self.parts["specular"]


class Linearised(NamedTuple):
    """One channel of some rows, whitened and weighted: a least-squares step on it is a step of the robust loss.

    places: number of the unknown (materials first, then the light's) of each of the k columns
    """

    rows: slice
    channel: int
    places: Int[np.ndarray, " k"]
    jacobian: Float[np.ndarray, "n k"]
    residual: Float[np.ndarray, " n"]


class Quadratic(NamedTuple):
    """A value, and half its gradient and half its Gauss–Newton Hessian by some unknowns."""

    value: float
    gradient: Float[np.ndarray, "*k"]
    hessian: Float[np.ndarray, "*k l"]


Chunks = Iterable[tuple[slice, Illumination]]


def tabulated(one: Illumination) -> Iterator[tuple[slice, Illumination]]:
    """The illumination in chunks of rows of one material, each with its `Responses`."""
    block, lobes, dtype = one.block, one.light.unit_lobes, one.operator.dtype
    for m, rows in material_slices(block):
        roughness, (nz, oz, _) = float(one.materials.roughness[m]), met_cosines(block, rows, lobes)
        inputs = np.float64(roughness), lobes.sharpness, (block.normal[rows] * block.view[rows]).sum(1), nz, oz
        response = one.operator.response(*(torch.as_tensor(value).to(dtype) for value in inputs))
        parts = {name: getattr(response, name).double() for name in response.__struct_fields__}
        if block.visibility is not None:
            every = torch.ones_like(parts["diffuse"])
            diffuse, specular = (shadowed(every, block, rows, lobes, how) for how in (None, roughness))
            parts = {name: part * (diffuse if name.startswith("diffuse") else specular) for name, part in parts.items()}
        table = Responses({name: part.numpy() for name, part in parts.items()})
        yield rows, msgspec.structs.replace(one, block=block.take(rows), table=table)


class Whitened(NamedTuple):
    """Residuals of a chunk, weighted, and their loss; a derivative of radiance times `scale` is a derivative of the residual."""

    residual: Float[np.ndarray, "n 3"]
    scale: Float[np.ndarray, "n 3"]
    loss: float


def whitened(one: Illumination, radiance: Float[np.ndarray, "n 3"], loss: Loss) -> Whitened:
    """Return the whitened residuals of observations that the model says show `radiance`; those that are held out have weight 0."""
    residual = one.block.residuals(radiance)
    pull = one.pull(residual, loss)
    lost = float(loss.of_residuals(residual)[~one.block.held_out].sum())
    return Whitened(residual * pull, one.block.precision * pull, lost)


def linearise(rows: slice, one: Illumination, loss: Loss) -> tuple[float, list[Linearised]]:
    """The loss of a chunk, and its whitened residuals and their Jacobian, channel by channel."""
    block, light, materials, exposure = one.block, one.light, one.materials, one.exposure
    shown, r, m, parts = one.shown(), one.table.parts, int(block.material[0]), []
    seen, (by_s, weight_by_s) = whitened(one, shown.radiance, loss), sharpness_slopes(light, materials.blur)
    by_tangent = [(block.normal @ t.T, block.view @ t.T) for t in tangents(light.axis)]
    photos = np.eye(len(light.log_exposure))[block.photo][:, 1:]
    for c in range(3):
        kd, ks, weight = materials.diffuse[m, c], materials.specular[m, c], light.weight[:, c]
        basis = one.table.basis(materials, m, c)
        by_nz = (kd * r["diffuse_by_nz"] + ks * r["specular_by_nz"]) * weight
        by_oz = ks * r["specular_by_oz"] * weight
        by_log_sharpness = kd * r["diffuse_by_log_sharpness"] + ks * r["specular_by_log_sharpness"]
        lit = [by_nz * n + by_oz * o for n, o in by_tangent]
        lit += [(by_log_sharpness * by_s + basis * weight_by_s) * weight, basis / light.unit_energy]
        lit += [photos * (basis @ weight)[:, None], ks * (r["specular_by_roughness"] @ weight)[:, None]]
        *others, by_roughness = (part * exposure for part in lit)
        own = [shown.diffuse[:, c, None], shown.specular[:, c, None], by_roughness]
        jacobian = np.hstack([*others, *own]) * seen.scale[:, c, None]
        parts.append(Linearised(rows, c, _places(light, len(materials), m, c), jacobian, seen.residual[:, c]))
    return seen.loss, parts


def places_of(illumination: Illumination) -> Int[np.ndarray, " k+l"]:
    """Numbers of the unknowns on which its radiance depends, ascending: 7 of each material that it shows, then the light's l."""
    shown = (7 * np.unique(illumination.block.material)[:, None] + np.arange(7)).reshape(-1)
    return np.concatenate([shown, 7 * len(illumination.materials) + np.arange(unknowns(illumination.light))])


def _places(light: Light, materials: int, m: int, c: int) -> Int[np.ndarray, " k"]:
    """Numbers of the unknowns of channel c: geometry and weights of the lobes, exposures, those of material m."""
    first, p = 7 * materials, len(light)
    light_ = np.r_[0 : 3 * p, (3 + c) * p : (4 + c) * p, 6 * p : unknowns(light)]
    return np.concatenate([first + light_, 7 * m + np.array([c, 3 + c, 6])])


def tint_prior(loss: Loss, block: Block, light: Light) -> Quadratic:
    """The paper's prior on the tint of a light, for n observations that are not held out and summed energies E:
    n π Σ_c (E_c/Ē − 1)² / 3, the variance over channels; the mean Ē is taken to be constant."""
    count, p = unknowns(light), len(light)
    strength = loss.prior * int((~block.held_out).sum()) / 3
    sums = light.energy.sum(0)
    centre = (np.eye(3) - 1 / 3) / max(float(sums.mean()), 1e-30)
    residual = centre @ sums
    gradient, hessian, energies = np.zeros(count), np.zeros((count, count)), slice(3 * p, 6 * p)
    gradient[energies] = strength * np.repeat(centre @ residual, p)  # centre is symmetric
    hessian[energies, energies] = strength * np.kron(centre @ centre, np.ones((p, p)))
    return Quadratic(strength * float(residual @ residual), gradient, hessian)


def normal_equations(
    illumination: Illumination, loss: Loss, chunks: Chunks | None = None, clustered: bool = False
) -> System:
    """The system of the observations that are not held out: the loss, and the prior on the tint.

    chunks: what is fitted, tabulated, where that was done before;  clustered: with scores of clusters
    """
    light, own, total = illumination.light, illumination.fitted(), 0.0
    every = places_of(own)
    size, k = len(every), len(every) - unknowns(light)
    hessian, gradient, scores = np.zeros((size, size)), np.zeros(size), None
    if clustered:
        numbers = illumination.block.clusters()
        scores, clusters = np.zeros((int(numbers.max(initial=-1)) + 1, size)), numbers[~illumination.block.held_out]
    for rows, chunk in tabulated(own) if chunks is None else chunks:
        lost, parts = linearise(rows, msgspec.structs.replace(chunk, light=light), loss)
        total += lost
        for part in parts:
            places, J = np.searchsorted(every, part.places), part.jacobian
            hessian[np.ix_(places, places)] += J.T @ J
            gradient[places] += J.T @ part.residual
            if scores is not None:
                np.add.at(scores, (clusters[rows][:, None], places[None]), J * part.residual[:, None])
    prior = tint_prior(loss, own.block, light)
    gradient[k:] += prior.gradient
    hessian[k:, k:] += prior.hessian
    blocks = hessian[:k, :k], gradient[k:], hessian[:k, k:], hessian[k:, k:]
    return System(total + prior.value, total, every[:k], gradient[:k], *blocks, np.zeros(size - k), scores)


def energy_equations(illumination: Illumination, chunks: Chunks, loss: Loss) -> Quadratic:
    """The part of `normal_equations` by the lobes' energies of each channel alone, [3, p] and [3, p, p], the same numbers."""
    light, materials = illumination.light, illumination.materials
    p, total = len(light), 0.0
    gradient, hessian = np.zeros((3, p)), np.zeros((3, p, p))
    for _, chunk in chunks:
        seen, m = whitened(chunk, chunk.radiance(), loss), int(chunk.block.material[0])
        for c in range(3):
            basis = chunk.table.basis(materials, m, c) / light.unit_energy
            scaled = basis * (chunk.exposure * seen.scale[:, c, None])
            hessian[c] += scaled.T @ scaled
            gradient[c] += scaled.T @ seen.residual[:, c]
        total += seen.loss
    prior = tint_prior(loss, illumination.block, light)
    for c in range(3):
        own = slice((3 + c) * p, (4 + c) * p)
        gradient[c] += prior.gradient[own]
        hessian[c] += prior.hessian[own, own]
    return Quadratic(total + prior.value, gradient, hessian)


def with_weights_fitted(illumination: Illumination, loss: Loss) -> tuple[Light, System]:
    """The light with the weights that lower the loss most, while nothing else changes, and the normal equations there.

    With clipped observations or outliers the loss is not quadratic in the weights.  If the fitted weights would raise the loss, the
    light keeps its own.
    """
    own = illumination.fitted()
    kept = list(tabulated(own)) if len(own.block) * len(own.light) <= KEPT else None
    before = energy_equations(own, tabulated(own) if kept is None else kept, loss)
    light = of_least_loss(own.light, before)
    after = normal_equations(msgspec.structs.replace(own, light=light), loss, kept)
    return (light, after) if after.value <= before.value else (own.light, normal_equations(own, loss, kept))


def of_least_loss(light: Light, equations: Quadratic) -> Light:
    """The non-negative weights that minimise the quadratic model by the energies of each channel, all else as it is."""
    energy = light.energy
    for c, (gradient, hessian) in enumerate(zip(equations.gradient, equations.hessian, strict=True)):
        energy[:, c] = nonnegative_minimum(hessian, hessian @ energy[:, c] - gradient)
    return msgspec.structs.replace(light, weight=energy / light.unit_energy[:, None])


def nonnegative_minimum(hessian: Float[np.ndarray, "p p"], target: Float[np.ndarray, " p"]) -> Float[np.ndarray, " p"]:
    """argmin over w ≥ 0 of ½ wᵀHw − tᵀw, H made definite by 1e-9 of its mean diagonal."""
    scale = np.sqrt(np.maximum(np.diag(hessian), 1e-12 * max(float(np.diag(hessian).max()), 1e-30)))
    normalised = hessian / np.outer(scale, scale) + 1e-9 * np.eye(len(scale))
    upper = cholesky(normalised)
    right = solve_triangular(upper, target / scale, trans="T")
    return nnls(upper, right, maxiter=50 * len(scale))[0] / scale
