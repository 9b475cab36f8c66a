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

from collections.abc import Callable, Iterable, Iterator

import msgspec
import numpy as np
import torch
from jaxtyping import Float, Int

from factorlib.elementary import product, square_root
from factorlib.images.tone import by_log_exponent, curve, slope
from factorlib.solve.problem import Block, not_held_out
from factorlib.solve.shadowing import Turning, shadowed, shadowed_response
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
    inputs = torch.tensor(roughness), torch.from_numpy(sharpness), (normal * view).sum(1), product(normal, axis.T), product(view, axis.T)
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
    return robust_loss(residual, loss.robust_scale)[0] + beforehand(block, light, loss)[0]


class Responses(msgspec.Struct, frozen=True):
    """What `rows` of one material reflect of each lobe at unit weight, as they are seen and exposed.

    parts: the fields of the operator's Response [n, p];  turning: how they change as lobes turn, by visibility alone
    """

    material: int
    rows: slice
    parts: dict[str, Float[torch.Tensor, "n p"]]
    turning: Turning | None


def responses(block: Block, light: Light, materials: Materials, operator) -> Iterator[Responses]:
    """Of all observations, some at a time."""
    for m, rows in material_slices(block):
        exposure = torch.from_numpy(np.exp(light.log_exposure)[block.photo[rows]])[:, None]
        response = operator.response(*operator_inputs(block, rows, light.axis, light.sharpness, materials.roughness[m], operator))
        parts = {name: getattr(response, name).double() * exposure for name in response.__struct_fields__}
        yield Responses(m, rows, *shadowed_response(parts, block, rows, light, materials.roughness[m]))


def system(
    block: Block,
    light: Light,
    materials: Materials,
    operator,
    loss: Loss,
    clusters: Int[np.ndarray, "n"] | None = None,
    shown: Iterable[Responses] | None = None,
) -> System:
    """Loss, gradient and Gauss–Newton Hessian of one illumination (all of Σ r², without the factor 2), of what is not held out.

    clusters: number of each observation's cluster, from 0, for `System.scores`;
    shown: the observations' responses to the light, where they are known already
    """
    k, size = 7 * len(materials), 7 * len(materials) + light.unknowns
    hessian, gradient = np.zeros((size, size)), np.zeros(size)
    scores = None if clusters is None else np.zeros((int(clusters.max(initial=-1)) + 1, size))
    if clusters is not None:
        clusters = clusters[~block.held_out]
    block, total = not_held_out(block), 0.0
    for some in responses(block, light, materials, operator) if shown is None else shown:
        for channel in whitened_rows(block, light, materials, some, loss):
            total += channel.loss
            places, scaled, residual = channel.places, channel.jacobian, channel.residual
            hessian[np.ix_(places, places)] += product(scaled.T, scaled).numpy()
            gradient[places] += product(scaled.T, residual).numpy()
            if scores is not None:
                np.add.at(scores, (clusters[some.rows][:, None], places[None]), (scaled * residual[:, None]).numpy())
    prior, prior_gradient, prior_hessian = beforehand(block, light, loss)
    gradient[k:] += prior_gradient
    hessian[k:, k:] += prior_hessian
    return System(total + prior, gradient[:k], gradient[k:], hessian[:k, :k], hessian[:k, k:], hessian[k:, k:], scores)


def energy_systems(
    block: Block, light: Light, materials: Materials, shown: Iterable[Responses], loss: Loss
) -> tuple[float, Float[np.ndarray, "3 p"], Float[np.ndarray, "3 p p"]]:
    """Loss, gradient and Hessian of one illumination as `system` has them, by the lobes' energies of each channel alone."""
    p, total = len(light), 0.0
    gradient, hessian = np.zeros((3, p)), np.zeros((3, p, p))
    weight, spread = torch.from_numpy(light.weight), torch.from_numpy(light.spread)
    for some in shown:
        for c in range(3):
            basis = _basis(some, materials, c)
            seen = _whitened(block, some.rows, c, product(basis, weight[:, c]), light, loss)
            scaled = basis / spread * (seen.rising * seen.scale[:, None])
            hessian[c] += product(scaled.T, scaled).numpy()
            gradient[c] += product(scaled.T, seen.residual).numpy()
            total += seen.loss
    prior, prior_gradient, prior_hessian = beforehand(block, light, loss)
    for c in range(3):
        own = slice((3 + c) * p, (4 + c) * p)
        gradient[c] += prior_gradient[own]
        hessian[c] += prior_hessian[own, own]
    return total + prior, gradient, hessian


class Channel(msgspec.Struct, frozen=True):
    """One channel of n rows, whitened and weighted so that a least-squares step on it is one of the robust loss.

    places: which unknowns (materials first, then the light's) the k columns of the Jacobian are
    """

    places: Int[np.ndarray, "k"]
    jacobian: Float[torch.Tensor, "n k"]
    residual: Float[torch.Tensor, "n"]
    loss: float


def whitened_rows(block: Block, light: Light, materials: Materials, some: Responses, loss: Loss) -> Iterator[Channel]:
    """The three channels of some observations; those that are held out weigh nothing."""
    p, first, m, rows, r = len(light), 7 * len(materials), some.material, some.rows, some.parts
    normal, view = torch.from_numpy(block.normal[rows]), torch.from_numpy(block.view[rows])
    tangents = [torch.from_numpy(t) for t in light.tangents()]
    by_tangent = [(product(normal, t.T), product(view, t.T)) for t in tangents]
    weight, spread = torch.from_numpy(light.weight), torch.from_numpy(light.spread)
    by_s, weight_by_s = (torch.from_numpy(slope) for slope in light.sharpness_slopes(materials.blur))
    photos = torch.nn.functional.one_hot(torch.from_numpy(block.photo[rows]), len(light.log_exposure)).double()
    end = first + 6 * p + len(light.log_exposure) - 1
    geometry, exposures, tones = np.arange(first, first + 3 * p), np.arange(first + 6 * p, end), np.arange(end, first + light.unknowns)
    for c in range(3):
        kd, ks = materials.diffuse[m, c], materials.specular[m, c]
        basis = _basis(some, materials, c)
        by_nz = (kd * r["diffuse_by_nz"] + ks * r["specular_by_nz"]) * weight[:, c]
        by_oz = ks * r["specular_by_oz"] * weight[:, c]
        columns = [by_nz * n + by_oz * o for n, o in by_tangent]
        if some.turning is not None:
            shading = [(kd * d + ks * s) * weight[:, c] for d, s in zip(some.turning.diffuse, some.turning.specular, strict=True)]
            columns = [column + also for column, also in zip(columns, shading, strict=True)]
        by_log_sharpness = kd * r["diffuse_by_log_sharpness"] + ks * r["specular_by_log_sharpness"]
        columns += [(by_log_sharpness * by_s + basis * weight_by_s) * weight[:, c], basis / spread]
        linear = product(basis, weight[:, c])
        lit = [product(r[name], weight[:, c]) for name in ("diffuse", "specular", "specular_by_roughness")]
        own = [lit[0], lit[1], ks * lit[2]]
        seen = _whitened(block, rows, c, linear, light, loss)
        jacobian = torch.cat([*columns, photos[:, 1:] * linear[:, None], torch.stack(own, 1)], 1) * seen.rising
        jacobian = torch.cat([jacobian, photos * seen.by_tone], 1) if len(light.log_tone) else jacobian
        weights = np.arange(first + (3 + c) * p, first + (4 + c) * p)
        places = np.concatenate([geometry, weights, exposures, [7 * m + c, 7 * m + 3 + c, 7 * m + 6], tones])
        yield Channel(places, jacobian * seen.scale[:, None], seen.residual, seen.loss)


def _basis(some: Responses, materials: Materials, c: int) -> Float[torch.Tensor, "n p"]:
    """Responses of the material in one channel."""
    return materials.diffuse[some.material, c] * some.parts["diffuse"] + materials.specular[some.material, c] * some.parts["specular"]


class Whitened(msgspec.Struct, frozen=True):
    """Residual and loss of one channel of n rows; scale: of a slope of radiance, to be one of the residual;
    rising, by_tone: slopes of radiance by linear radiance and by the log exponents [n, 1]."""

    residual: Float[torch.Tensor, "n"]
    scale: Float[torch.Tensor, "n"]
    rising: Float[torch.Tensor, "n 1"] | float
    by_tone: Float[torch.Tensor, "n 1"] | float
    loss: float


def _whitened(block: Block, rows: slice, c: int, linear: Float[torch.Tensor, "n"], light: Light, loss: Loss) -> Whitened:
    predicted, rising, by_tone = _toned_with_slopes(linear, block, rows, light)
    fit = torch.from_numpy((~block.held_out[rows]).astype(float))
    precision = torch.from_numpy(block.precision[rows, c])
    difference = (predicted - torch.from_numpy(block.radiance[rows, c])) * precision
    satisfied = torch.from_numpy(block.clipped[rows, c]) & (difference > 0)
    residual = torch.where(satisfied, 0.0, difference)
    root = square_root(1 + (residual / loss.robust_scale) ** 2)
    pull = square_root(fit / root * ~satisfied)
    lost = float((2 * loss.robust_scale**2 * (root - 1) * fit).sum())
    return Whitened(residual * pull, precision * pull, rising, by_tone, lost)


def _toned_with_slopes(linear: Float[torch.Tensor, "n"], block: Block, rows: slice, light: Light):
    """Radiance [n] as the photos show it, and its slopes [n, 1] by linear radiance and by the log exponents."""
    if len(light.log_tone) == 0:
        return linear, 1.0, 0.0
    x, exponent = linear.clamp(min=0).numpy()[:, None], exponents(light, block.photo[rows])
    shown, rising, by_tone = (torch.from_numpy(of(x, exponent)) for of in (curve, slope, by_log_exponent))
    return shown[:, 0], rising, by_tone


def beforehand(block: Block, light: Light, loss: Loss) -> tuple[float, Float[np.ndarray, "l"], Float[np.ndarray, "l l"]]:
    """Value, gradient and Hessian, by the light's unknowns, of all that the loss holds beside residuals."""
    gradient, hessian = np.zeros(light.unknowns), np.zeros((light.unknowns, light.unknowns))
    lobes = slice(2 * len(light), 6 * len(light))
    value, gradient[lobes], hessian[lobes, lobes] = _prior(block, light, loss)
    if loss.light_prior is None:
        return value, gradient, hessian
    known, by_unknown, curved = loss.light_prior(block, light)
    return value + known, gradient + by_unknown, hessian + curved


def _prior(block: Block, light: Light, loss: Loss):
    """The tint prior over the unknowns [s, e_R, e_G, e_B] × p, with the mean Ē held: value, gradient, Hessian."""
    strength = loss.prior * int((~block.held_out).sum()) / 3
    sums = light.energy.sum(0)
    centre = (np.eye(3) - 1 / 3) / max(float(sums.mean()), 1e-30)
    residual = centre @ sums
    by_lobes = np.hstack([np.zeros((3, len(light))), np.kron(np.eye(3), np.ones(len(light)))])  # of the sums
    jacobian = centre @ by_lobes
    return strength * float(residual @ residual), strength * jacobian.T @ residual, strength * jacobian.T @ jacobian
