"""Residuals of one illumination and their normal equations.

    predicted  y_ic = τ_i(e_i Σ_p w_pc B_ipc),     B_ipc = k_d,c D_ip + k_s,c S_ip,  τ the photo's tone curve
    residual   r_ic = (y_ic − radiance_ic) / σ_ic, and min(r_ic, 0) where the channel is clipped: a clipped pixel says
                                                   "at least this much"
    loss       Σ 2k² (√(1 + r²/k²) − 1)            pseudo-Huber: wrong normals and mask borders pull with bounded force
             + n π Σ_c (E_c/Ē − 1)² / 3            the paper's prior, on summed energies: variance over channels

D (diffuse) and S (specular) are the responses of a unit lobe, from the reflection operator with their derivatives.
Channels share the geometry unknowns (axis, sharpness) and have their own weights, so the Gram matrix is assembled
from one [n, 4p] block per channel rather than from a sparse [3n, 6p] Jacobian.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import msgspec
import numpy as np
import torch
from jaxtyping import Float, Int

from factorlib.images.tone import by_log_exponent, curve, slope
from factorlib.solve.problem import Block
from factorlib.solve.shadowing import shadowed, shadowed_response
from factorlib.solve.tone import exponents, toned
from factorlib.solve.unknowns import Light, Materials

CHUNK = 4096  # observations whose responses are held at once


LightPrior = Callable[[Block, Light], tuple[float, Float[np.ndarray, "l"], Float[np.ndarray, "l l"]]]


class Loss(msgspec.Struct, frozen=True):
    """robust_scale: k of the pseudo-Huber loss, in σ;  prior: weight π of the paper's tint prior.

    light_prior: what is known of lights beforehand, as from captured ones; off where None.  It adds a value ρ(light) to the loss of
    each illumination: ρ, half its gradient and half its Gauss-Newton Hessian by the light's unknowns (`Light.moved`)
    """

    robust_scale: float = 10.0
    prior: float = 1e-4
    light_prior: LightPrior | None = None


class System(msgspec.Struct, frozen=True):
    """Gauss–Newton system of one illumination: gradient and Hessian blocks of materials (m) and light (l).

    scores: the gradient's part from each cluster of observations, where clusters were asked for
    """

    loss: float
    material_gradient: Float[np.ndarray, "7m"]
    light_gradient: Float[np.ndarray, "l"]
    material_hessian: Float[np.ndarray, "7m 7m"]
    cross_hessian: Float[np.ndarray, "7m l"]
    light_hessian: Float[np.ndarray, "l l"]
    scores: Float[np.ndarray, "k 7m+l"] | None = None


def operator_inputs(block: Block, rows, axis: Float[np.ndarray, "p 3"], sharpness: Float[np.ndarray, "p"], roughness: float, operator):
    """roughness, sharpness, n·o, n·z, o·z of lobes at the observations `rows`, as the operator takes them."""
    normal, view, axis = (torch.from_numpy(v) for v in (block.normal[rows], block.view[rows], axis))
    inputs = torch.tensor(roughness), torch.from_numpy(sharpness), (normal * view).sum(1), normal @ axis.T, view @ axis.T
    return [t.to(operator.dtype) for t in inputs]


def material_slices(block: Block) -> list[tuple[int, slice]]:
    """(material, rows) of runs of one material, of at most CHUNK rows."""
    starts = np.flatnonzero(np.diff(block.material, prepend=-1))
    ends = np.append(starts, len(block))[1:]
    return [
        (int(block.material[a]), slice(i, min(i + CHUNK, b)))
        for a, b in zip(starts.tolist(), ends.tolist(), strict=True)
        for i in range(a, b, CHUNK)
    ]


def predicted_radiance(block: Block, light: Light, materials: Materials, operator) -> Float[np.ndarray, "n 3"]:
    """Radiance of every observation, in the block's unit."""
    radiance = np.zeros_like(block.radiance)
    exposure = np.exp(light.log_exposure)[block.photo]
    for m, rows in material_slices(block):
        roughness, sharpness, no, nz, oz = operator_inputs(block, rows, light.axis, light.sharpness, materials.roughness[m], operator)
        with torch.no_grad():
            parts = operator.diffuse(sharpness, nz), operator.specular(roughness, sharpness, no, nz, oz)
            parts = shadowed(parts, block, rows, light.axis, light.sharpness, materials.roughness[m])
        diffuse, specular = (part.double().numpy() @ light.weight for part in parts)
        radiance[rows] = exposure[rows, None] * (materials.diffuse[m] * diffuse + materials.specular[m] * specular)
    return toned(radiance, light, block.photo)


def residuals(block: Block, predicted: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Whitened residuals, one-sided where clipped."""
    difference = (predicted - block.radiance) * block.precision
    return np.where(block.clipped, np.minimum(difference, 0.0), difference)


def robust_loss(residual: Float[np.ndarray, "n 3"], scale: float) -> tuple[float, Float[np.ndarray, "n 3"]]:
    """Pseudo-Huber loss and the weights that make its Gauss–Newton step a least-squares one."""
    return float(np.sum(robust_losses(residual, scale))), 1 / np.sqrt(1 + (residual / scale) ** 2)


def robust_losses(residual: Float[np.ndarray, "n 3"], scale: float) -> Float[np.ndarray, "n 3"]:
    return 2 * scale**2 * (np.sqrt(1 + (residual / scale) ** 2) - 1)


def fit_loss(block: Block, light: Light, materials: Materials, operator, loss: Loss) -> float:
    """The loss of one illumination over what is not held out, prior included."""
    residual = residuals(block, predicted_radiance(block, light, materials, operator))[~block.held_out]
    beforehand = loss.light_prior(block, light)[0] if loss.light_prior else 0.0
    return robust_loss(residual, loss.robust_scale)[0] + _prior(block, light, loss)[0] + beforehand


def system(
    block: Block, light: Light, materials: Materials, operator, loss: Loss, clusters: Int[np.ndarray, "n"] | None = None
) -> System:
    """Loss, gradient and Gauss–Newton Hessian of one illumination (all of Σ r², without the factor 2).

    clusters: number of each observation's cluster, from 0, for `System.scores`
    """
    p, m = len(light), len(materials)
    size = light.unknowns
    hessian = np.zeros((7 * m + size, 7 * m + size))
    gradient = np.zeros(7 * m + size)
    scores = None if clusters is None else np.zeros((int(clusters.max(initial=-1)) + 1, 7 * m + size))
    total = 0.0
    for index, rows in material_slices(block):
        response = operator.response(*operator_inputs(block, rows, light.axis, light.sharpness, materials.roughness[index], operator))
        own = None if clusters is None else (scores, clusters[rows])
        total += _add_rows(hessian, gradient, own, block, rows, light, materials, index, response, loss)
    prior, prior_gradient, prior_hessian = _prior(block, light, loss)
    lobes = slice(7 * m + 2 * p, 7 * m + 6 * p)
    gradient[lobes] += prior_gradient
    hessian[lobes, lobes] += prior_hessian
    k = 7 * m
    if loss.light_prior:
        beforehand, light_gradient, light_hessian = loss.light_prior(block, light)
        prior += beforehand
        gradient[k:] += light_gradient
        hessian[k:, k:] += light_hessian
    return System(total + prior, gradient[:k], gradient[k:], hessian[:k, :k], hessian[:k, k:], hessian[k:, k:], scores)


def _add_rows(hessian, gradient, scores, block: Block, rows: slice, light: Light, materials: Materials, m: int, response, loss: Loss) -> float:
    """Add the rows of one material; returns their loss."""
    total = 0.0
    for channel in whitened_rows(block, rows, light, materials, m, response, loss):
        total += channel.loss
        places, scaled, residual = channel.places, channel.jacobian, channel.residual
        hessian[np.ix_(places, places)] += (scaled.T @ scaled).numpy()
        gradient[places] += (scaled.T @ residual).numpy()
        if scores is not None:
            np.add.at(scores[0], (scores[1][:, None], places[None]), (scaled * residual[:, None]).numpy())
    return total


class Channel(msgspec.Struct, frozen=True):
    """One channel of n rows, whitened and weighted so that a least-squares step on it is one of the robust loss.

    places: which unknowns (materials first, then the light's) the k columns of the Jacobian are
    """

    places: Int[np.ndarray, "k"]
    jacobian: Float[torch.Tensor, "n k"]
    residual: Float[torch.Tensor, "n"]
    loss: float


def whitened_rows(block: Block, rows: slice, light: Light, materials: Materials, m: int, response, loss: Loss) -> Iterator[Channel]:
    """The three channels of rows of material m; rows that are held out weigh nothing."""
    p, first = len(light), 7 * len(materials)
    exposure = torch.from_numpy(np.exp(light.log_exposure)[block.photo[rows]])[:, None]
    normal, view = torch.from_numpy(block.normal[rows]), torch.from_numpy(block.view[rows])
    tangents = [torch.from_numpy(t) for t in light.tangents()]
    by_tangent = [(normal @ t.T, view @ t.T) for t in tangents]
    r = {name: getattr(response, name).double() * exposure for name in response.__struct_fields__}
    r, turning = shadowed_response(r, block, rows, light, materials.roughness[m])
    weight, spread = torch.from_numpy(light.weight), torch.from_numpy(light.spread)
    by_s, weight_by_s = (torch.from_numpy(slope) for slope in light.sharpness_slopes(materials.blur))
    fit = torch.from_numpy((~block.held_out[rows]).astype(float))
    photos = torch.nn.functional.one_hot(torch.from_numpy(block.photo[rows]), len(light.log_exposure)).double()
    end = first + 6 * p + len(light.log_exposure) - 1
    geometry, exposures, tones = np.arange(first, first + 3 * p), np.arange(first + 6 * p, end), np.arange(end, first + light.unknowns)
    for c in range(3):
        kd, ks = materials.diffuse[m, c], materials.specular[m, c]
        basis = kd * r["diffuse"] + ks * r["specular"]
        by_nz = (kd * r["diffuse_by_nz"] + ks * r["specular_by_nz"]) * weight[:, c]
        by_oz = ks * r["specular_by_oz"] * weight[:, c]
        columns = [by_nz * n + by_oz * o for n, o in by_tangent]
        if turning is not None:
            shading = [(kd * d + ks * s) * weight[:, c] for d, s in zip(turning.diffuse, turning.specular, strict=True)]
            columns = [column + also for column, also in zip(columns, shading, strict=True)]
        by_log_sharpness = kd * r["diffuse_by_log_sharpness"] + ks * r["specular_by_log_sharpness"]
        columns += [(by_log_sharpness * by_s + basis * weight_by_s) * weight[:, c], basis / spread]
        linear = basis @ weight[:, c]
        predicted, rising, by_tone = _toned_with_slopes(linear, block, rows, light)
        own = [r["diffuse"] @ weight[:, c], r["specular"] @ weight[:, c], ks * (r["specular_by_roughness"] @ weight[:, c])]
        jacobian = torch.cat([*columns, photos[:, 1:] * linear[:, None], torch.stack(own, 1)], 1) * rising
        jacobian = torch.cat([jacobian, photos * by_tone], 1) if len(light.log_tone) else jacobian
        precision = torch.from_numpy(block.precision[rows, c])
        difference = (predicted - torch.from_numpy(block.radiance[rows, c])) * precision
        satisfied = torch.from_numpy(block.clipped[rows, c]) & (difference > 0)
        residual = torch.where(satisfied, 0.0, difference)
        root = torch.sqrt(1 + (residual / loss.robust_scale) ** 2)
        pull = (fit / root * ~satisfied).sqrt()
        weights = np.arange(first + (3 + c) * p, first + (4 + c) * p)
        places = np.concatenate([geometry, weights, exposures, [7 * m + c, 7 * m + 3 + c, 7 * m + 6], tones])
        lost = float((2 * loss.robust_scale**2 * (root - 1) * fit).sum())
        yield Channel(places, jacobian * (precision * pull)[:, None], residual * pull, lost)


def _toned_with_slopes(linear: Float[torch.Tensor, "n"], block: Block, rows: slice, light: Light):
    """Radiance [n] as the photos show it, and its slopes [n, 1] by linear radiance and by the log exponents."""
    if len(light.log_tone) == 0:
        return linear, 1.0, 0.0
    x, exponent = linear.clamp(min=0).numpy()[:, None], exponents(light, block.photo[rows])
    shown, rising, by_tone = (torch.from_numpy(of(x, exponent)) for of in (curve, slope, by_log_exponent))
    return shown[:, 0], rising, by_tone


def _prior(block: Block, light: Light, loss: Loss):
    """The tint prior over the unknowns [s, e_R, e_G, e_B] × p, with the mean Ē held: value, gradient, Hessian."""
    strength = loss.prior * int((~block.held_out).sum()) / 3
    sums = light.energy.sum(0)
    centre = (np.eye(3) - 1 / 3) / max(float(sums.mean()), 1e-30)
    residual = centre @ sums
    by_lobes = np.hstack([np.zeros((3, len(light))), np.kron(np.eye(3), np.ones(len(light)))])  # of the sums
    jacobian = centre @ by_lobes
    return strength * float(residual @ residual), strength * jacobian.T @ residual, strength * jacobian.T @ jacobian
