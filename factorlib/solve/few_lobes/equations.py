"""One light of few lobes at a point: responses, derivatives, normal equations, and its lobes' weights given everything else.

Channels share the unknowns of geometry (axis, sharpness) and have their own weights.  So the Jacobian is one dense block
[n, 4p + …] per channel instead of a sparse matrix [3n, 6p + …].  Shadows multiply responses and their derivatives; that they change as a lobe
turns is left out of the Jacobian, for a step is taken only if it lowers the loss itself.

Normal equations are half the gradient and half the Gauss–Newton Hessian of the loss (for Σ r²: Jᵀr and JᵀJ).  The weights are a non-negative
least-squares problem per channel.  They are solved for on the Cholesky factor of the Gram matrix, so its size is the number of lobes, not of
observations.  Clipped channels and outliers get the weights that they have at the current residual.
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
from torch import Tensor

from factorlib.elementary import product, square_root
from factorlib.model.blocks import Block
from factorlib.model.illumination import Illumination, material_slices
from factorlib.model.lights import Light
from factorlib.model.loss import Loss
from factorlib.model.materials import Materials
from factorlib.model.responses import cosines, shadowed
from factorlib.solve.few_lobes.unknowns import sharpness_slopes, tangents, unit_energy, unknowns

KEPT = 1 << 20  # responses of observations to lobes that stay in memory; if there are more, they are computed twice


class Responses(msgspec.Struct, frozen=True):
    """What `rows` of one material reflect of each lobe of weight one, with shadows and exposure.

    parts   the fields of the operator's Response [n, p]: D and S of `factorlib.model.responses` and their derivatives
    """

    material: int
    rows: slice
    parts: dict[str, Float[Tensor, "n p"]]

    def basis(self, materials: Materials, c: int) -> Float[Tensor, "n p"]:
        """Radiance in channel c by the lobes' weights there: k_d D + k_s S, exposed."""
        return (
            materials.diffuse[self.material, c] * self.parts["diffuse"]
            + materials.specular[self.material, c] * self.parts["specular"]
        )

    def linear(self, block: Block, light: Light, materials: Materials, c: int) -> Float[Tensor, " n"]:
        """Radiance in channel c, with what other surfaces send."""
        lit = product(self.basis(materials, c), torch.from_numpy(light.weight)[:, c])
        if block.bounced is None:
            return lit
        diffuse, specular = (torch.from_numpy(block.bounced[self.rows, k]) for k in (c, 3 + c))
        return lit + materials.diffuse[self.material, c] * diffuse + materials.specular[self.material, c] * specular


class Linearised(msgspec.Struct, frozen=True):
    """One channel of some rows, whitened and weighted: a least-squares step on it is a step of the robust loss.

    Rows that are held out have weight 0.  places: number of the unknown (materials first, then the light's) of each of the k columns
    """

    rows: slice
    channel: int
    places: Int[np.ndarray, " k"]
    jacobian: Float[Tensor, "n k"]
    residual: Float[Tensor, " n"]
    loss: float


class NormalEquations(msgspec.Struct, frozen=True):
    """Gauss–Newton system of one illumination: gradient and Hessian blocks of the materials that it shows (k unknowns) and its light (l).

    places: numbers of the k unknowns among those of all materials, ascending
    scores: the gradient's part from each of g clusters of observations, where they were asked for
    """

    loss: float
    places: Int[np.ndarray, " k"]
    material_gradient: Float[np.ndarray, " k"]
    light_gradient: Float[np.ndarray, " l"]
    material_hessian: Float[np.ndarray, "k k"]
    cross_hessian: Float[np.ndarray, "k l"]
    light_hessian: Float[np.ndarray, "l l"]
    scores: Float[np.ndarray, "g k+l"] | None = None


class Quadratic(NamedTuple):
    """A value, and half its gradient and half its Gauss–Newton Hessian by some unknowns."""

    value: float
    gradient: Float[np.ndarray, "*k"]
    hessian: Float[np.ndarray, "*k l"]


def places_of(illumination: Illumination) -> Int[np.ndarray, " k+l"]:
    """Numbers of the unknowns on which its radiance depends, ascending: 7 of each material that it shows, then the light's l."""
    shown = (7 * np.unique(illumination.block.material)[:, None] + np.arange(7)).reshape(-1)
    return np.concatenate([shown, 7 * len(illumination.materials) + np.arange(unknowns(illumination.light))])


def tint_prior(loss: Loss, block: Block, light: Light) -> Quadratic:
    """The paper's prior on the tint of a light, for n observations that are not held out and summed energies E:
    n π Σ_c (E_c/Ē − 1)² / 3, the variance over channels; the mean Ē is taken to be constant."""
    count, p = unknowns(light), len(light)
    strength = loss.prior * int((~block.held_out).sum()) / 3
    sums = light.energy.sum(0)
    centre = (np.eye(3) - 1 / 3) / max(float(sums.mean()), 1e-30)
    residual = centre @ sums
    by_lobes = np.hstack([np.zeros((3, p)), np.kron(np.eye(3), np.ones(p))])  # of the sums, by [s, e_R, e_G, e_B] × p
    jacobian = centre @ by_lobes
    gradient, hessian, lobes = np.zeros(count), np.zeros((count, count)), slice(2 * p, 6 * p)
    gradient[lobes], hessian[lobes, lobes] = strength * jacobian.T @ residual, strength * jacobian.T @ jacobian
    return Quadratic(strength * float(residual @ residual), gradient, hessian)


def responses(illumination: Illumination) -> Iterator[Responses]:
    """The responses of all observations of an illumination, in chunks of rows."""
    block, light, operator = illumination.block, illumination.light, illumination.operator
    for m, rows in material_slices(block):
        roughness = float(illumination.materials.roughness[m])
        exposure = torch.from_numpy(illumination.exposure[rows])
        inputs = np.float64(roughness), light.sharpness, *cosines(block.normal[rows], block.view[rows], light.axis)
        response = operator.response(*(torch.as_tensor(value).to(operator.dtype) for value in inputs))
        parts = {name: getattr(response, name).double() * exposure for name in response.__struct_fields__}
        if block.visibility is not None:
            every = torch.ones_like(parts["diffuse"])
            diffuse, specular = (shadowed(every, block, rows, light.unit_lobes, how) for how in (None, roughness))
            parts = {name: part * (diffuse if name.startswith("diffuse") else specular) for name, part in parts.items()}
        yield Responses(m, rows, parts)


def linearise(illumination: Illumination, loss: Loss, known: Iterable[Responses] | None = None) -> Iterator[Linearised]:
    """Whitened residuals and their Jacobian, in chunks of rows and channel by channel; known: `responses`, if computed before."""
    block, light, materials = illumination.block, illumination.light, illumination.materials
    weight, per_energy = torch.from_numpy(light.weight), torch.from_numpy(unit_energy(light))
    by_s, weight_by_s = (torch.from_numpy(of) for of in sharpness_slopes(light, materials.blur))
    for some in responses(illumination) if known is None else known:
        m, rows, r = some.material, some.rows, some.parts
        normal, view = torch.from_numpy(block.normal[rows]), torch.from_numpy(block.view[rows])
        by_tangent = [(product(normal, t.T), product(view, t.T)) for t in map(torch.from_numpy, tangents(light.axis))]
        photos = torch.nn.functional.one_hot(torch.from_numpy(block.photo[rows]), len(light.log_exposure)).double()
        for c in range(3):
            kd, ks = materials.diffuse[m, c], materials.specular[m, c]
            basis = some.basis(materials, c)
            by_nz = (kd * r["diffuse_by_nz"] + ks * r["specular_by_nz"]) * weight[:, c]
            by_oz = ks * r["specular_by_oz"] * weight[:, c]
            columns = [by_nz * n + by_oz * o for n, o in by_tangent]
            by_log_sharpness = kd * r["diffuse_by_log_sharpness"] + ks * r["specular_by_log_sharpness"]
            columns += [(by_log_sharpness * by_s + basis * weight_by_s) * weight[:, c], basis / per_energy]
            columns.append(photos[:, 1:] * product(basis, weight[:, c])[:, None])
            own = [product(r[name], weight[:, c]) for name in ("diffuse", "specular", "specular_by_roughness")]
            own[2] = ks * own[2]
            if block.bounced is not None:
                own[:2] = [part + torch.from_numpy(block.bounced[rows, k]) for part, k in zip(own, (c, 3 + c))]
            seen = whitened(block, rows, c, some.linear(block, light, materials, c), loss)
            jacobian = torch.cat([*columns, torch.stack(own, 1)], 1) * seen.scale[:, None]
            yield Linearised(rows, c, _places(light, len(materials), m, c), jacobian, seen.residual, seen.loss)


def _places(light: Light, materials: int, m: int, c: int) -> Int[np.ndarray, " k"]:
    """Numbers of the unknowns of channel c: geometry and weights of the lobes, exposures, those of material m."""
    first, p = 7 * materials, len(light)
    geometry, weights = np.arange(3 * p), np.arange((3 + c) * p, (4 + c) * p)
    light_ = np.concatenate([geometry, weights, np.arange(6 * p, unknowns(light))])
    return np.concatenate([first + light_, [7 * m + c, 7 * m + 3 + c, 7 * m + 6]])


class Whitened(NamedTuple):
    """Residual and loss of one channel of n rows; a derivative of radiance times `scale` is a derivative of the residual."""

    residual: Float[Tensor, " n"]
    scale: Float[Tensor, " n"]
    loss: float


def whitened(block: Block, rows: slice, c: int, radiance: Float[Tensor, " n"], loss: Loss) -> Whitened:
    """Channel c of `rows`, whose radiance is `radiance`."""
    fit = torch.from_numpy((~block.held_out[rows]).astype(float))
    precision = torch.from_numpy(block.precision[rows, c])
    difference = (radiance - torch.from_numpy(block.radiance[rows, c])) * precision
    satisfied = torch.from_numpy(block.clipped[rows, c]) & (difference > 0)
    residual = torch.where(satisfied, 0.0, difference)
    root = square_root(1 + (residual / loss.robust_scale) ** 2)
    pull = square_root(fit / root * ~satisfied)
    lost = float((2 * loss.robust_scale**2 * (root - 1) * fit).sum())
    return Whitened(residual * pull, precision * pull, lost)


def normal_equations(
    illumination: Illumination, loss: Loss, known: Iterable[Responses] | None = None, clustered: bool = False
) -> NormalEquations:
    """The system of the observations that are not held out.

    known: responses of what is fitted to the light, where they were computed before;  clustered: with scores of clusters
    """
    light, own, total = illumination.light, illumination.fitted(), 0.0
    every = places_of(own)
    size, k = len(every), len(every) - unknowns(light)
    hessian, gradient, scores = np.zeros((size, size)), np.zeros(size), None
    if clustered:
        numbers = illumination.block.clusters()
        scores, clusters = np.zeros((int(numbers.max(initial=-1)) + 1, size)), numbers[~illumination.block.held_out]
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


def energy_equations(illumination: Illumination, known: Iterable[Responses], loss: Loss) -> Quadratic:
    """The part of `normal_equations` by the lobes' energies of each channel alone, [3, p] and [3, p, p], the same numbers.

    known: responses of all observations to the light
    """
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
    return Quadratic(total + prior.value, gradient, hessian)


def with_weights_fitted(illumination: Illumination, loss: Loss) -> tuple[Light, NormalEquations]:
    """The light with the weights that lower the loss most, while nothing else changes, and the normal equations there.

    With clipped observations or outliers the loss is not quadratic in the weights.  If the fitted weights would raise the loss, the
    light keeps its own.
    """
    own = illumination.fitted()
    kept = list(responses(own)) if len(own.block) * len(own.light) <= KEPT else None
    before = energy_equations(own, responses(own) if kept is None else kept, loss)
    light = of_least_loss(own.light, before)
    after = normal_equations(msgspec.structs.replace(own, light=light), loss, kept)
    return (light, after) if after.loss <= before.value else (own.light, normal_equations(own, loss, kept))


def of_least_loss(light: Light, equations: Quadratic) -> Light:
    """The non-negative weights that minimise the quadratic model by the energies of each channel, all else as it is."""
    energy = light.energy
    for c, (gradient, hessian) in enumerate(zip(equations.gradient, equations.hessian, strict=True)):
        energy[:, c] = nonnegative_minimum(hessian, hessian @ energy[:, c] - gradient)
    return msgspec.structs.replace(light, weight=energy / unit_energy(light)[:, None])


def nonnegative_minimum(hessian: Float[np.ndarray, "p p"], target: Float[np.ndarray, " p"]) -> Float[np.ndarray, " p"]:
    """argmin over w ≥ 0 of ½ wᵀHw − tᵀw, H made definite by 1e-9 of its mean diagonal."""
    scale = np.sqrt(np.maximum(np.diag(hessian), 1e-12 * max(float(np.diag(hessian).max()), 1e-30)))
    normalised = hessian / np.outer(scale, scale) + 1e-9 * np.eye(len(scale))
    upper = cholesky(normalised)
    right = solve_triangular(upper, target / scale, trans="T")
    return nnls(upper, right, maxiter=50 * len(scale))[0] / scale
