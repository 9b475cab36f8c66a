"""The derivatives of an illumination's residuals by the unknowns of the materials and of its light as few lobes.

Channels share the unknowns of geometry (axis, sharpness) and have their own weights.  So the Jacobian is one dense block
[n, 4p + …] per channel instead of a sparse matrix [3n, 6p + …].  Shadows multiply responses and their derivatives; that they change as a lobe
turns is left out of the Jacobian, for a step is taken only if it lowers the loss itself.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import msgspec
import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from factorlib.elementary import product, square_root
from factorlib.model.blocks import Block
from factorlib.model.illumination import Illumination, material_slices
from factorlib.model.lights import Light, tangents
from factorlib.model.loss import Loss
from factorlib.model.materials import Materials
from factorlib.model.responses import cosines
from factorlib.model.shadowing import shadowed_diffuse, shadowed_specular
from factorlib.solve.few_lobes.unknowns import sharpness_slopes, unit_energy, unknowns


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


class Whitened(NamedTuple):
    """Residual and loss of one channel of n rows; a derivative of radiance times `scale` is a derivative of the residual."""

    residual: Float[Tensor, " n"]
    scale: Float[Tensor, " n"]
    loss: float


class Quadratic(NamedTuple):
    """A value, and half its gradient and half its Gauss–Newton Hessian by the l unknowns of a light (`unknowns.moved_light`)."""

    value: float
    gradient: Float[np.ndarray, " l"]
    hessian: Float[np.ndarray, "l l"]


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
        exposure = torch.from_numpy(np.exp(light.log_exposure)[block.photo[rows]])[:, None]
        inputs = np.float64(roughness), light.sharpness, *cosines(block.normal[rows], block.view[rows], light.axis)
        response = operator.response(*(torch.as_tensor(value).to(operator.dtype) for value in inputs))
        parts = {name: getattr(response, name).double() * exposure for name in response.__struct_fields__}
        if block.visibility is not None:
            every = torch.ones_like(parts["diffuse"])
            diffuse = shadowed_diffuse(every, block, rows, light.unit_lobes)
            specular = shadowed_specular(every, block, rows, light.unit_lobes, roughness)
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
