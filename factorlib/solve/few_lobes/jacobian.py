"""The derivatives of an illumination's residuals by the unknowns of the materials and of its light as few lobes.

Channels share the unknowns of geometry (axis, sharpness) and have their own weights.  So the Jacobian is one dense block
[n, 4p + …] per channel instead of a sparse matrix [3n, 6p + …].
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import msgspec
import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from factorlib.elementary import product, square_root
from factorlib.images.tone import by_log_exponent, curve, slope
from factorlib.model.blocks import Block
from factorlib.model.illumination import Illumination
from factorlib.model.lights import Light, tangents
from factorlib.model.loss import Loss
from factorlib.model.materials import Materials
from factorlib.model.tone import exponents
from factorlib.solve.few_lobes.responses import Responses, responses
from factorlib.solve.few_lobes.tint import tint_prior
from factorlib.solve.few_lobes.unknowns import sharpness_slopes, unit_energy, unknowns


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


class Whitened(msgspec.Struct, frozen=True):
    """Residual and loss of one channel of n rows.

    scale     a derivative of radiance times this is a derivative of the residual
    rising    derivative of the radiance shown by linear radiance;  by_tone: by the log exponents of the tone curves
    """

    residual: Float[Tensor, " n"]
    scale: Float[Tensor, " n"]
    rising: Float[Tensor, "n 1"] | float
    by_tone: Float[Tensor, "n 1"] | float
    loss: float


def places_of(illumination: Illumination) -> Int[np.ndarray, " k+l"]:
    """Numbers of the unknowns on which its radiance depends, ascending: 7 of each material that it shows, then the light's l."""
    shown = 7 * np.unique(illumination.block.material)[:, None] + np.arange(7)
    return np.concatenate(
        [shown.reshape(-1), 7 * len(illumination.materials) + np.arange(unknowns(illumination.light))]
    )


def fitted(illumination: Illumination) -> Illumination:
    """With the observations alone that are not held out."""
    return msgspec.structs.replace(illumination, block=illumination.block.fitted())


def with_light(illumination: Illumination, light: Light) -> Illumination:
    """The same observations and materials in another light."""
    return msgspec.structs.replace(illumination, light=light)


def fit_loss(illumination: Illumination, loss: Loss) -> float:
    """The loss of the observations that are not held out, with the prior."""
    block = illumination.block
    residual = illumination.residuals()[~block.held_out]
    return float(np.sum(loss.of_residuals(residual))) + tint_prior(loss, block, illumination.light).value


def linearise(illumination: Illumination, loss: Loss, known: Iterable[Responses] | None = None) -> Iterator[Linearised]:
    """Whitened residuals and their Jacobian, in chunks of rows and channel by channel; known: `responses`, if computed before."""
    for some in responses(illumination) if known is None else known:
        yield from linearised(illumination.block, illumination.light, illumination.materials, some, loss)


def linearised(block: Block, light: Light, materials: Materials, some: Responses, loss: Loss) -> Iterator[Linearised]:
    """The three channels of some observations."""
    p, m, rows, r = len(light), some.material, some.rows, some.parts
    normal, view = torch.from_numpy(block.normal[rows]), torch.from_numpy(block.view[rows])
    by_tangent = [(product(normal, t.T), product(view, t.T)) for t in map(torch.from_numpy, tangents(light.axis))]
    weight, per_energy = torch.from_numpy(light.weight), torch.from_numpy(unit_energy(light))
    by_s, weight_by_s = (torch.from_numpy(of) for of in sharpness_slopes(light, materials.blur))
    photos = torch.nn.functional.one_hot(torch.from_numpy(block.photo[rows]), len(light.log_exposure)).double()
    for c in range(3):
        kd, ks = materials.diffuse[m, c], materials.specular[m, c]
        basis = some.basis(materials, c)
        by_nz = (kd * r["diffuse_by_nz"] + ks * r["specular_by_nz"]) * weight[:, c]
        by_oz = ks * r["specular_by_oz"] * weight[:, c]
        columns = [by_nz * n + by_oz * o for n, o in by_tangent]
        if some.turning is not None:
            shading = [
                (kd * d + ks * s) * weight[:, c]
                for d, s in zip(some.turning.diffuse, some.turning.specular, strict=True)
            ]
            columns = [column + also for column, also in zip(columns, shading, strict=True)]
        by_log_sharpness = kd * r["diffuse_by_log_sharpness"] + ks * r["specular_by_log_sharpness"]
        columns += [(by_log_sharpness * by_s + basis * weight_by_s) * weight[:, c], basis / per_energy]
        linear = product(basis, weight[:, c])
        lit = [product(r[name], weight[:, c]) for name in ("diffuse", "specular", "specular_by_roughness")]
        own, shown = [lit[0], lit[1], ks * lit[2]], linear
        if block.bounced is not None:
            sent = [torch.from_numpy(block.bounced[rows, k]) for k in (c, 3 + c)]
            own, shown = [own[0] + sent[0], own[1] + sent[1], own[2]], linear + kd * sent[0] + ks * sent[1]
        seen = whitened(block, light, rows, c, shown, loss)
        jacobian = torch.cat([*columns, photos[:, 1:] * linear[:, None], torch.stack(own, 1)], 1) * seen.rising
        jacobian = torch.cat([jacobian, photos * seen.by_tone], 1) if len(light.log_tone) else jacobian
        places = _places(light, len(materials), m, c, p)
        yield Linearised(rows, c, places, jacobian * seen.scale[:, None], seen.residual, seen.loss)


def _places(light: Light, materials: int, m: int, c: int, p: int) -> Int[np.ndarray, " k"]:
    """Numbers of the unknowns of channel c: geometry and weights of the lobes, exposures, those of material m, tones."""
    first = 7 * materials
    end = first + 6 * p + len(light.log_exposure) - 1
    geometry, exposures, tones = (
        np.arange(first, first + 3 * p),
        np.arange(first + 6 * p, end),
        np.arange(end, first + unknowns(light)),
    )
    weights = np.arange(first + (3 + c) * p, first + (4 + c) * p)
    return np.concatenate([geometry, weights, exposures, [7 * m + c, 7 * m + 3 + c, 7 * m + 6], tones])


def whitened(block: Block, light: Light, rows: slice, c: int, linear: Float[Tensor, " n"], loss: Loss) -> Whitened:
    """Channel c of `rows`, whose linear radiance is `linear`."""
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


def _toned_with_slopes(
    linear: Float[Tensor, " n"], block: Block, rows: slice, light: Light
) -> tuple[Float[Tensor, " n"], Float[Tensor, "n 1"] | float, Float[Tensor, "n 1"] | float]:
    """Radiance as the photos show it, and its slopes by linear radiance and by the log exponents."""
    if len(light.log_tone) == 0:
        return linear, 1.0, 0.0
    x, exponent = linear.clamp(min=0).numpy()[:, None], exponents(light, block.photo[rows])
    shown, rising, by_tone = (torch.from_numpy(of(x, exponent)) for of in (curve, slope, by_log_exponent))
    return shown[:, 0], rising, by_tone
