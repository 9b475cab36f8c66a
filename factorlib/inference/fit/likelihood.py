"""Marginal likelihood of the materials with the lights integrated out, and its normal equations, for one illumination.

A light is u, log radiance on cells, with a Gaussian prior of mean m and precision Q.  It states the statistics of
natural light, of mean 0 (`factorlib.light.prior`), or these given the surroundings that photos show
(`factorlib.inference.model.background`).  The forward model gives residuals r in σ of the noise model.  Neighbouring
residuals are correlated, so a squared residual counts as 1/T of one (`factorlib.inference.fit.fit`).  Minus twice the
log posterior of a light is

    φ(u; θ) = Σ ρ(r)/T + (u − m)ᵀ Q (u − m).

Laplace's approximation about the minimising u integrates the light out.  Minus twice the log marginal likelihood of θ
is then

    φ(u; θ) + log det H − log det Q,        H = JᵀJ/T + Q,     J = ∂r/∂u                                            (1)

up to a constant.  The rows of J are weighted by the robust loss, and those of clipped channels that are bright enough
are zero.  Shadows on the ground (`factorlib.inference.model.cast_shadows`) are further residuals, which do not depend
on θ. Without the determinant, light and materials are ambiguous.  The ambiguity then always favours the light of least
contrast and the materials of least roughness, as blind deconvolution favours no blur (Levin et al. 2009, "Understanding
and evaluating blind deconvolution algorithms").  Radiance is linear in w ∝ exp(u) and in exposures e, so ∂J/∂θ, ∂J/∂u
and ∂J/∂log e are exact but for robust weights, clipping and slopes of tone curves, which are taken as constant.
With Σ = H⁻¹

    ½ ∂ log det H/∂θ = Σ_i J_i Σ (∂J_i/∂θ)ᵀ / T,
    ½ ∂ log det H/∂u_j = Σ_i (J_i Σ)_j J_ij / T,      ½ ∂ log det H/∂log e_f = Σ_{i in photo f} J_i Σ J_iᵀ / T.      (2)

The latter two act on materials through the light that they imply, du/dθ = −L⁻¹Cᵀ (`factorlib.inference.fit.optimizer`).
Without them, all reflectances would fall: a brighter light under darker materials has the same J.  The Gauss–Newton
Hessian of the first, Σ_i ∂J_i Σ ∂J_iᵀ, only steers the steps of a descent.  Every `HESSIAN_STRIDE`-th row therefore
stands for its neighbours.

Materials enter as log k_d, log k_s (RGB each) and roughness, 7 unknowns θ each.  Exposures and tone exponents belong to
the light's block but are not integrated out.  They have wide Gaussian priors about 0.

Cells of known radiance (`Light.fixed`) are not part of u in (1) and (2).  Q is then the precision of the other cells,
given the known ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import msgspec
import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import LinAlgError, cho_solve
from scipy.linalg.blas import ssyrk
from scipy.linalg.lapack import dpotrf, dpotri

from factorlib.inference.model.blocks import RobustLoss
from factorlib.inference.model.cast_shadows import CastShadows
from factorlib.inference.model.forward import Gradient, Illumination, Linearised
from factorlib.inference.model.lights import DARKEST, Light
from factorlib.inference.model.materials import UNKNOWNS, Materials
from factorlib.light.prior import LightPrior

HESSIAN_STRIDE = 8  # one row in so many enters the Hessian of the determinant
# Standard deviation of a log exposure: half a stop, relative to EXIF where a photo has it.  Where every photo of a
# light shows one material, observations do not distinguish exposure from reflectance, and this prior decides.
EXPOSURE_DEVIATION = 0.35
TONE_DEVIATION = 0.3  # standard deviation of a log tone exponent


class System(NamedTuple):
    """Contribution of one illumination to the objective, half its gradient and half its Gauss–Newton Hessian.

    The k unknowns of the materials are those the block shows; the light has l unknowns.

    Attributes:
        value: Contribution to the objective.
        loss: Sum of the robust losses in `value`.
        places: Indices of the block's material unknowns, ascending.
        material_gradient: g_m.
        material_hessian: M.
        light_gradient: g_i.
        cross_hessian: C_i.
        light_hessian: L_i.
        factor: Lower Cholesky factor of L_i.
        determinant_by_materials: Half the gradient of log det H with respect to materials.
        determinant_hessian: Half its Hessian with respect to materials.
        determinant_by_light: Half the gradient of log det H with respect to the light; it acts on materials only.
        scores: Contributions of requested groups of observations to the gradient, materials then light, one row a
            group.
    """

    value: float
    loss: float
    places: Int[np.ndarray, " k"]
    material_gradient: Float[np.ndarray, " k"]
    material_hessian: Float[np.ndarray, "k k"]
    light_gradient: Float[np.ndarray, " l"]
    cross_hessian: Float[np.ndarray, "k l"]
    light_hessian: Float[np.ndarray, "l l"]
    factor: Float[np.ndarray, "l l"]
    determinant_by_materials: Float[np.ndarray, " k"]
    determinant_hessian: Float[np.ndarray, "k k"]
    determinant_by_light: Float[np.ndarray, " l"]
    scores: Float[np.ndarray, "g k+l"]


class LightLikelihood(msgspec.Struct, frozen=True):
    """Marginal likelihood of the observations in one light, under the prior on that light.

    Attributes:
        illumination: Observations and light, with its table of responses.
        prior: Prior on the light.
        log_peaks: Log of the cells' weights at radiance 1.
        mean: m, channel by channel, over all cells and suns.
        precision: Q, likewise.
        log_determinant: log det Q of the free cells and suns.
        temperature: T, which divides squared residuals.
        turn_variance: Variance of the turns η of poses.
        loss: Robust loss ρ.
        ground: Shadows on the ground; None without.
    """

    illumination: Illumination
    prior: LightPrior
    log_peaks: Float[np.ndarray, " p"]
    mean: Float[np.ndarray, " 3p"]
    precision: Float[np.ndarray, "3p 3p"]
    log_determinant: float
    temperature: float
    turn_variance: float
    loss: RobustLoss
    ground: CastShadows | None = None

    @property
    def light(self) -> Light:
        """Light of this likelihood."""
        return self.illumination.light

    @property
    def log_radiance(self) -> Float[np.ndarray, "3 p"]:
        """u, log radiance of each cell, channel by channel."""
        return np.log(np.maximum(self.light.weight.T, DARKEST)) - self.log_peaks

    def with_point(self, light: Light | None = None, materials: Materials | None = None) -> LightLikelihood:
        """Return the same likelihood at another light or other materials, with the same table."""
        current = self.illumination
        illumination = msgspec.structs.replace(
            current, light=light or current.light, materials=materials or current.materials
        )
        return msgspec.structs.replace(self, illumination=illumination)

    def gradient(self) -> Gradient:
        """Return φ, minus twice the log posterior of the light, and half its gradient by materials and light."""
        data = self.illumination.gradient(self.loss, self.temperature)
        value, slope = self._prior()
        if self.ground is not None:
            shadows, by_cells = self.ground.gradient(self.light.weight, self.loss, self.temperature)
            value += shadows
            slope[: by_cells.size] += by_cells.T.reshape(-1)
        return Gradient(data.value + value, data.by_materials, data.by_light + slope)

    def normal_equations(self, determinants: bool = True, group: Int[np.ndarray, " n"] | None = None) -> System:
        """Return the value of (1) and its normal equations.

        Args:
            determinants: False for φ instead of (1), without the determinants and their costly derivatives.
            group: Number of each observation's group, from 0, for `System.scores`; None for no scores.
        """
        illumination = self.illumination
        prediction = illumination.predict()
        p = int(illumination.light.free.sum())
        places = (UNKNOWNS * np.unique(illumination.block.material)[:, None] + np.arange(UNKNOWNS)).reshape(-1)
        k = len(places)
        size = illumination.light.unknowns
        value, g_l = self._prior()
        g_m = np.zeros(k)
        M = np.zeros((k, k))
        C = np.zeros((k, size))
        L = self._prior_hessian()
        parts = list(illumination.linearise(prediction, self.loss, self.temperature))
        photos = slice(3 * p, size)  # behind u, the first 3p unknowns of the light
        # H = JᵀJ/T + Q, (1), block by block: L = H of the light, M of the materials, C between them
        for part in parts:
            cells = slice(part.channel * p, (part.channel + 1) * p)
            rows = np.searchsorted(places, part.places)
            J = part.diffuse + part.specular
            L[cells, cells] += gram_matrix(J)
            g_l[cells] += J.T @ part.residual
            M[np.ix_(rows, rows)] += part.by_material.T @ part.by_material
            g_m[rows] += part.by_material.T @ part.residual
            C[rows, cells] += part.by_material.T @ J
            L[photos, photos] += part.by_photo.T @ part.by_photo
            g_l[photos] += part.by_photo.T @ part.residual
            C[rows, photos] += part.by_material.T @ part.by_photo
            photo_cells = part.by_photo.T @ J
            L[photos, cells] += photo_cells
            L[cells, photos] += photo_cells.T
        value += self._add_ground(L, g_l)
        loss = illumination.fitted_loss(illumination.block.residuals(prediction.radiance), self.loss)
        factor = cholesky_factor(L)
        determinant = (np.zeros(k), np.zeros((k, k)), np.zeros(size))
        value += loss / self.temperature
        if determinants:
            value += self._determinants(factor)
            determinant = _determinant_derivatives(parts, factor, places, illumination)
        scores = np.zeros((0, k + size)) if group is None else _scores(parts, group, places, size)
        return System(value, loss, places, g_m, M, g_l, C, L, factor, *determinant, scores)

    def marginal(self, system: System) -> float:
        """Return the value of (1) at a minimum of φ, from a system of φ."""
        return system.value + self._determinants(system.factor)

    def _determinants(self, factor: Float[np.ndarray, "l l"]) -> float:
        """Return log det H − log det Q."""
        return 2 * float(np.log(np.diag(factor)[: self.light.integrated]).sum()) - self.log_determinant

    def _prior(self) -> tuple[float, Float[np.ndarray, " l"]]:
        """Return (u − m)ᵀQ(u − m) plus the Gaussian priors of exposures and tones, and half the gradient."""
        u = self.log_radiance.reshape(-1) - self.mean
        photo_values, width = self._photo_unknowns()
        slope = self.precision @ u
        free = np.tile(self.light.free, 3)
        gradient = [slope[free], photo_values / width**2]
        if self.light.scale_free:  # the derivative of all fixed cells together
            gradient.append(slope[~free].sum(keepdims=True))
        return float(u @ slope + np.sum((photo_values / width) ** 2)), np.concatenate(gradient)

    def _prior_hessian(self) -> Float[np.ndarray, "l l"]:
        """Return half the Hessian of `_prior`."""
        free = np.tile(self.light.free, 3)
        _, width = self._photo_unknowns()
        p = int(free.sum())
        hessian = np.zeros((self.light.unknowns, self.light.unknowns))
        hessian[:p, :p] = self.precision if free.all() else self.precision[np.ix_(free, free)]
        hessian[range(p, p + len(width)), range(p, p + len(width))] = width**-2
        if self.light.scale_free:
            fixed_rows = self.precision[~free].sum(0)
            hessian[-1, :p] = hessian[:p, -1] = fixed_rows[free]
            hessian[-1, -1] = fixed_rows[~free].sum()
        return hessian

    def _add_ground(self, L: Float[np.ndarray, "l l"], g_l: Float[np.ndarray, " l"]) -> float:
        """Add the ground to half the Hessian and half the gradient of the light; return its robust loss over T."""
        if self.ground is None:
            return 0.0
        p = len(self.light)
        for c, (J, r) in enumerate(self.ground.linearise(self.light.weight, self.loss, self.temperature)):
            cells = slice(c * p, (c + 1) * p)
            L[cells, cells] += gram_matrix(J)
            g_l[cells] += J.T @ r
        return self.ground.gradient(self.light.weight, self.loss, self.temperature)[0]

    def _photo_unknowns(self) -> tuple[Float[np.ndarray, " q"], Float[np.ndarray, " q"]]:
        """Return turns, free log exposures and log tone exponents, and their standard deviations."""
        light = self.light
        exposures = light.log_exposure[len(light.log_exposure) - light.free_exposures :]
        values = light.turns, exposures, light.log_tone
        deviations = float(np.sqrt(self.turn_variance)), EXPOSURE_DEVIATION, TONE_DEVIATION
        return np.concatenate(values), np.repeat(deviations, list(map(len, values)))


def _scores(
    parts: Sequence[Linearised], group: Int[np.ndarray, " n"], places: Int[np.ndarray, " k"], size: int
) -> Float[np.ndarray, "g k+l"]:
    """Return the sum over each group of every derivative times its residual.

    Args:
        parts: All channels and materials of a light.
        group: Number of each observation's group.
        places: Numbers of the materials' unknowns.
        size: l, number of the light's unknowns.
    """
    k = len(places)
    scores = np.zeros((int(group.max(initial=-1)) + 1, k + size))
    for part in parts:
        p = part.diffuse.shape[1]
        start = k + part.channel * p
        summing = (group[part.rows] == np.arange(len(scores))[:, None]) * part.residual
        scores[:, np.searchsorted(places, part.places)] += summing @ part.by_material
        scores[:, start : start + p] += summing @ (part.diffuse + part.specular)
        scores[:, k + 3 * p :] += summing @ part.by_photo
    return scores


def _determinant_derivatives(
    parts: Sequence[Linearised],
    factor: Float[np.ndarray, "l l"],
    places: Int[np.ndarray, " k"],
    illumination: Illumination,
) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, "k k"], Float[np.ndarray, " l"]]:
    """Return (2) summed over channels and materials: by materials, their Hessian, and by the light.

    Args:
        parts: Linearised observations by channel and material.
        factor: Lower Cholesky factor of the light's Hessian.
        places: Indices of the k material unknowns.
        illumination: Illumination of the parts.
    """
    k = len(places)
    light = illumination.light
    p = int(light.free.sum())
    integrated = light.integrated
    covariance = cholesky_inverse(factor[:integrated, :integrated])  # Σ of u and η
    by_materials = np.zeros(k)
    by_materials_twice = np.zeros((k, k))
    by_light = np.zeros(light.unknowns)
    by_exposure = np.zeros(len(light.log_exposure))
    for part in parts:
        cells = slice(part.channel * p, (part.channel + 1) * p)
        rows = np.searchsorted(places, part.places)
        Σ = covariance[cells, cells].astype(np.float32)
        by_turns = part.by_photo[:, : len(light.turns)]
        # ∂J by log k_d, log k_s and roughness; the first two are the two parts of J
        slopes = (part.diffuse, part.specular, part.by_roughness)
        J = part.diffuse + part.specular
        # Σ_i J_i Σ ∂J_iᵀ and Σ_i (J_i Σ)_j J_ij, (2)
        JΣ = J @ Σ + by_turns @ covariance[3 * p :, cells].astype(np.float32)
        by_materials[rows] += [float(np.vdot(JΣ, slope)) for slope in slopes]
        by_cell = JΣ * J
        by_light[cells] += by_cell.sum(0)
        # an exposure multiplies the rows J_i of its photo
        by_exposure += np.bincount(illumination.block.photo[part.rows], by_cell.sum(1), len(by_exposure))
        # Σ_i ∂J_i Σ ∂J_iᵀ, from every HESSIAN_STRIDE-th row
        sparse = [slope[::HESSIAN_STRIDE] for slope in slopes]
        stride = len(J) / max(len(sparse[0]), 1)
        hessian = np.array([[float(np.vdot(a @ Σ, b)) for b in sparse] for a in sparse])
        by_materials_twice[np.ix_(rows, rows)] += stride * hessian
    free_exposures = slice(integrated, integrated + light.free_exposures)
    by_light[free_exposures] = by_exposure[len(by_exposure) - light.free_exposures :]
    return by_materials, by_materials_twice, by_light


def gram_matrix(J: Float[np.ndarray, "n p"]) -> Float[np.ndarray, "p p"]:
    """Return the Gram matrix JᵀJ; BLAS computes one triangle of it."""
    lower = ssyrk(1.0, J.T, lower=1)
    return lower + np.tril(lower, -1).T


def cholesky_factor(matrix: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    """Return the lower Cholesky factor of a symmetric positive definite matrix.

    Raises:
        LinAlgError: If the matrix is not positive definite, or not finite.
    """
    if not len(matrix):
        return matrix
    factor, failed = dpotrf(matrix, lower=1, clean=1)
    if failed or not np.isfinite(np.diag(factor)).all():
        raise LinAlgError(f"a matrix of {len(matrix)} rows is not positive definite, or not finite")
    return factor


def cholesky_inverse(factor: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    """Return the inverse of the matrix whose lower Cholesky factor is given, exactly symmetric.

    >>> cholesky_inverse(cholesky_factor(np.array([[4.0, 0.0], [0.0, 0.25]]))).tolist()
    [[0.25, 0.0], [0.0, 4.0]]
    """
    if not len(factor):
        return factor
    inverse, _ = dpotri(factor, lower=1)
    lower = np.tril(inverse, -1)
    return lower + lower.T + np.diag(np.diag(inverse))


def solve_cholesky(factor: Float[np.ndarray, "l l"], values: Float[np.ndarray, "l ..."]) -> Float[np.ndarray, "l ..."]:
    """Solve L x = `values` for a vector or for columns, with L given by its lower Cholesky factor."""
    return cho_solve((factor, True), values, check_finite=False)
