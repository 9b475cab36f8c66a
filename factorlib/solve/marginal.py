"""The marginal likelihood of the materials, the lights integrated out: one illumination's part of it, and its normal equations.

A light is u, log radiance on a lattice; its prior is Gaussian with mean 0 and precision Q (`factorlib.light.prior`).  Observations are
those of the forward model, with residuals r in σ of the noise model.  Neighbours' residuals err alike, so a squared residual counts as
1/T of one (`factorlib.solve.natural.temperature`).  Minus twice the log posterior of a light is

    φ(u; θ) = Σ ρ(r)/T + uᵀ Q u,

and with the light integrated out (Laplace's approximation about the minimising u) minus twice the log marginal likelihood of θ is

    φ(u; θ) + log det H,        H = JᵀJ/T + Q,     J = ∂r/∂u                                                        (1)

up to a constant.  Without the determinant, light and materials are ambiguous in a way that always favours the light of least contrast and
the materials of least roughness, as blind deconvolution favours no blur (Levin et al. 2009, "Understanding and evaluating blind
deconvolution algorithms").  Of a radiance that is linear in w = exp(u), ∂J/∂θ is known exactly, and with Σ = H⁻¹

    ½ ∂ log det H/∂θ = Σ_i J_i Σ (∂J_i/∂θ)ᵀ / T.                                                                 (2)

Materials enter as log k_d, log k_s (RGB each) and roughness: 7 unknowns θ each.
"""

from __future__ import annotations

from typing import NamedTuple

import msgspec
import numpy as np
from jaxtyping import Float, Int

from factorlib.model.blocks import Block
from factorlib.model.lights import Light
from factorlib.model.materials import Materials
from factorlib.model.tone import slope_at, toned
from factorlib.solve.cholesky import positive_definite_inverse
from factorlib.solve.lattice import Lattice, Reflected, Reflections


class Field(msgspec.Struct, frozen=True):
    """One illumination: its observations, its lattice, its prior, and how much they count.

    light        gives exposures and tone curves, which stay
    precision    Q, channel by channel
    temperature  T;  robust_scale: of the pseudo-Huber loss ρ, in σ
    """

    block: Block
    light: Light
    lattice: Lattice
    reflections: Reflections
    precision: Float[np.ndarray, "3p 3p"]
    temperature: float
    robust_scale: float


class Shown(NamedTuple):
    """Of the observations at a light and materials: residuals r, and the diffuse and specular radiances for k_d = 1 and k_s = 1."""

    residual: Float[np.ndarray, "n 3"]
    diffuse: Float[np.ndarray, "n 3"]
    specular: Float[np.ndarray, "n 3"]
    slope: Float[np.ndarray, "n 3"]
    responses: list[tuple[int, slice, Reflected]]


class Marginal(NamedTuple):
    """The value of (1), the loss Σ ρ(r) in it, and the Gauss–Newton system of it: half the gradient and half the Hessian.

    scores   the parts of the gradient of φ by materials and light, one a cluster of observations, where clusters were asked for
    """

    value: float
    loss: float
    material_gradient: Float[np.ndarray, " 7m"]
    material_hessian: Float[np.ndarray, "7m 7m"]
    light_gradient: Float[np.ndarray, " 3p"]
    cross_hessian: Float[np.ndarray, "7m 3p"]
    light_hessian: Float[np.ndarray, "3p 3p"]
    scores: Float[np.ndarray, "k 7m+3p"] | None = None


def shown(field: Field, log_radiance: Float[np.ndarray, "3 p"], materials: Materials) -> Shown:
    """What the model shows; radiance as `factorlib.model.illumination` has it, on the lattice."""
    block, weight = field.block, field.lattice.weight(log_radiance).astype(np.float32)
    diffuse, specular = np.empty((len(block), 3)), np.empty((len(block), 3))
    responses = [
        (int(m), field.reflections.rows(m), field.reflections.at(m, float(materials.roughness[m]))) for m in np.unique(block.material)
    ]
    for _, rows, of in responses:
        diffuse[rows], specular[rows] = of.diffuse @ weight, of.specular @ weight
    exposure = _exposure(field)
    diffuse, specular = diffuse * exposure, specular * exposure
    if block.bounced is not None:
        diffuse, specular = diffuse + block.bounced[:, :3], specular + block.bounced[:, 3:]
    linear = materials.diffuse[block.material] * diffuse + materials.specular[block.material] * specular
    radiance = toned(linear, field.light, block.photo)
    slope = np.broadcast_to(slope_at(radiance, field.light, block.photo), radiance.shape)
    return Shown(block.residuals(radiance), diffuse, specular, slope, responses)


def loss_of(field: Field, seen: Shown) -> float:
    """Σ ρ(r) of what is fitted."""
    k, residual = field.robust_scale, seen.residual[~field.block.held_out]
    return 2 * k**2 * float(np.sum(np.sqrt(1 + (residual / k) ** 2) - 1))


def marginal(
    field: Field,
    log_radiance: Float[np.ndarray, "3 p"],
    materials: Materials,
    clusters: Int[np.ndarray, " n"] | None = None,
    materials_given: bool = False,
) -> Marginal:
    """The system of one illumination.

    clusters: number of each observation's cluster, from 0, for `Marginal.scores`;  materials_given: only the light is asked for, and
    equation (2), which takes most of the time, is left out of the gradient and the Hessian by materials
    """
    seen, p, count = shown(field, log_radiance, materials), len(field.lattice), 7 * len(materials)
    u = log_radiance.reshape(-1)
    gradient, hessian = field.precision @ u, field.precision.copy()
    by_material, of_materials, cross = np.zeros(count), np.zeros((count, count)), np.zeros((count, 3 * p))
    scores = None if clusters is None else np.zeros((int(clusters.max(initial=-1)) + 1, count + 3 * p))
    channels = []
    for c in range(3):
        own = slice(c * p, (c + 1) * p)
        for part in _channel(field, log_radiance, materials, seen, c):
            jacobian, places = part.diffuse + part.specular, part.places
            hessian[own, own] += jacobian.T @ jacobian
            gradient[own] += jacobian.T @ part.residual
            of_materials[np.ix_(places, places)] += part.by_material.T @ part.by_material
            by_material[places] += part.by_material.T @ part.residual
            cross[places, own] += part.by_material.T @ jacobian
            if scores is not None:
                of = clusters[part.rows]
                np.add.at(scores, (of[:, None], places[None]), part.by_material * part.residual[:, None])
                for k in np.unique(of):
                    scores[k, count + c * p : count + (c + 1) * p] += jacobian[of == k].T @ part.residual[of == k]
            channels.append((own, part))
    covariance, log_determinant = positive_definite_inverse(hessian)
    loss = loss_of(field, seen)
    total = loss / field.temperature + float(u @ field.precision @ u) + log_determinant
    for own, part in () if materials_given else channels:
        slopes = (part.diffuse, part.specular, part.by_roughness)
        spread = [slope @ covariance[own, own].astype(np.float32) for slope in slopes]
        by_material[part.places] += [float(np.vdot(spread[0] + spread[1], slope)) for slope in slopes]
        of_materials[np.ix_(part.places, part.places)] += [[float(np.vdot(a, b)) for b in slopes] for a in spread]
    return Marginal(total, loss, by_material, of_materials, gradient, cross, hessian, scores)


class _Part(NamedTuple):
    """One channel of the observations of one material, whitened, weighted by the robust loss and divided by √T.

    diffuse, specular   parts of ∂r/∂u [n, p];  by_roughness: of ∂²r/∂u ∂roughness;  by_material: ∂r/∂θ [n, 3] of unknowns `places`
    """

    rows: slice
    places: Int[np.ndarray, "3"]
    diffuse: Float[np.ndarray, "n p"]
    specular: Float[np.ndarray, "n p"]
    by_roughness: Float[np.ndarray, "n p"]
    by_material: Float[np.ndarray, "n 3"]
    residual: Float[np.ndarray, " n"]


def _channel(field: Field, log_radiance: Float[np.ndarray, "3 p"], materials: Materials, seen: Shown, c: int) -> list[_Part]:
    block, exposure, weight = field.block, _exposure(field)[:, 0], field.lattice.weight(log_radiance)[:, c]
    residual, parts = seen.residual[:, c], []
    root = np.sqrt(1 + (residual / field.robust_scale) ** 2)
    counts = ~block.held_out & ~(block.clipped[:, c] & (residual >= 0))
    pull = np.sqrt(counts / root / field.temperature)
    scale = pull * block.precision[:, c] * seen.slope[:, c]
    for m, rows, of in seen.responses:
        kd, ks = materials.diffuse[m, c], materials.specular[m, c]
        lit = (scale[rows] * exposure[rows])[:, None].astype(np.float32) * weight.astype(np.float32)
        by_roughness = of.by_roughness * (np.float32(ks) * lit)
        own = [kd * seen.diffuse[rows, c] * scale[rows], ks * seen.specular[rows, c] * scale[rows], by_roughness.sum(1, dtype=float)]
        parts.append(
            _Part(
                rows,
                7 * m + np.array([c, 3 + c, 6]),
                of.diffuse * (np.float32(kd) * lit),
                of.specular * (np.float32(ks) * lit),
                by_roughness,
                np.column_stack(own).astype(np.float32),
                (residual * pull)[rows].astype(np.float32),
            )
        )
    return parts


def _exposure(field: Field) -> Float[np.ndarray, "n 1"]:
    return np.exp(field.light.log_exposure)[field.block.photo][:, None]
