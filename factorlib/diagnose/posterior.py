"""Standard errors of materials and lights of the joint solve (`factorlib.solve.solve`).

Materials   The information is the Schur complement of φ's system (`factorlib.solve.marginal`): what the observations say once each light has
            taken up its share.  It is taken by reflectances, for by their logarithms a nil reflectance would look exactly known.  As in
            `factorlib.diagnose.uncertainty` its inverse and two sandwiches, over clusters of mirror directions and over whole lights, are
            compared, and the largest counts.  The prior on materials is left out.  More observations do not remove errors of the model
            itself, mostly of the mesh: MODEL_ERROR is added in quadrature, in proportion to the residuals up to those of the noise model.
Lights      Given the materials, log radiance has covariance Σ = H⁻¹ (equation (1) of `factorlib.solve.marginal`).  A map's radiance in
            direction d is Σ_p φ_p(d) w_p with w_p = peak_p exp(u_p), so its variance is gᵀ Σ g with g_p = φ_p(d) w_p.  Where no observation
            tells anything, Σ is the prior's covariance.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.linalg import cho_factor, cho_solve

from factorlib.conventions import YUP_FROM_CAMERA, lat_long_directions
from factorlib.diagnose.coverage import LARGEST, ROWS
from factorlib.diagnose.uncertainty import WIDTHS, StandardErrors, in_gauge, inverse_of, residual_deviation, sandwich
from factorlib.light.lobes import squared_distances
from factorlib.light.prior import LightPrior
from factorlib.model.clusters import clusters_of
from factorlib.model.illumination import Illumination
from factorlib.model.materials import Materials
from factorlib.model.point import Point
from factorlib.model.problem import JointProblem
from factorlib.solve.fit import Fit, Hyperparameters, field_of
from factorlib.solve.marginal import Marginal, marginal, positive_definite_inverse
from factorlib.solve.material_prior import materials_of, unknowns_of

# Standard deviations, relative of k_d and k_s, absolute of roughness, where residuals are those of the noise model: with them about 70 % of
# true values lie within one standard error on sets that settings were chosen on (data/eames and the eames-like sets of seeds 11 and 13;
# without, 62, 51 and 27 %).
MODEL_ERROR = np.array([0.03] * 3 + [0.15] * 3 + [0.03])


class Posterior:
    """What is uncertain at a fit; problem: what it was fitted to."""

    def __init__(self, problem: JointProblem, fit: Fit, prior: LightPrior):
        self.problem, self.fit, self.prior = problem, fit, prior
        self.materials = materials_of(unknowns_of(fit.point.materials))  # none of whose reflectances is nil

    def systems(self, with_scores: bool) -> list[Marginal]:
        """φ's system of each illumination; with_scores: of clusters of observations, too."""

        def system(one: tuple[Illumination, Hyperparameters]) -> Marginal:
            """Of one illumination."""
            clusters = clusters_of(one[0].block) if with_scores else None
            return marginal(field_of(*one, self.prior, not with_scores), clusters, materials_given=True)

        illuminations = self.problem.fitted().illuminations(Point(self.materials, self.fit.point.lights))
        return list(self.problem.spread(system, list(zip(illuminations, self.fit.hyperparameters, strict=True))))

    def standard_errors(self) -> StandardErrors:
        """Standard error of every material unknown."""
        materials, blocks = self.materials, self.problem.blocks
        size, widths = 7 * len(materials), np.tile(WIDTHS, len(materials))
        by_log = 1 / np.column_stack([materials.diffuse, materials.specular, np.ones(len(materials))]).reshape(
            -1
        )  # ∂ log k/∂k
        information, scores = np.diag(widths**-2.0), []  # nothing is less known than its range says
        for system in self.systems(with_scores=True):
            places, k = system.places, len(system.places)
            taken_up = cho_solve(cho_factor(system.light_hessian), system.cross_hessian.T)  # by the light
            own = (system.material_hessian - system.cross_hessian @ taken_up) * np.outer(by_log[places], by_log[places])
            information[np.ix_(places, places)] += own
            scores.append(np.zeros((len(system.scores), size)))
            scores[-1][:, places] = (system.scores[:, :k] - system.scores[:, k:] @ taken_up) * by_log[places]
        inverse = inverse_of(information)
        covariances = (
            inverse,
            sandwich(inverse, np.vstack(scores), 1.0),
            sandwich(inverse, np.array([s.sum(0) for s in scores]), 1.0),
        )
        variances = [np.diag(in_gauge(covariance, materials, blocks)) for covariance in covariances]
        deviation = residual_deviation(self.problem, self.fit.point)
        values = np.column_stack([materials.diffuse, materials.specular, np.ones(len(materials))])
        model_error = (min(1.0, deviation) * MODEL_ERROR * values).reshape(-1)
        errors = np.minimum(np.sqrt(np.max(variances, axis=0).clip(0) + model_error**2), widths).reshape(-1, 7)
        return StandardErrors(Materials(errors[:, :3], errors[:, 3:6], errors[:, 6]), deviation)

    def relative_standard_errors(self) -> dict[str, Float[np.ndarray, "h w 3"]]:
        """By illumination, over the light's mean radiance: a small lat-long map in the frame of the exported ones, at most LARGEST."""
        directions = (lat_long_directions(ROWS, 2 * ROWS) @ YUP_FROM_CAMERA).reshape(-1, 3)
        maps = {}
        for block, light, system in zip(
            self.problem.blocks, self.fit.point.lights, self.systems(with_scores=False), strict=True
        ):
            p, errors = len(light), np.empty((len(directions), 3))
            covariance = positive_definite_inverse(system.light_hessian[: 3 * p, : 3 * p]).matrix
            overlap = np.exp(-0.5 * light.sharpness * squared_distances(directions, light.axis))
            for c in range(3):
                own, slope = slice(c * p, (c + 1) * p), overlap * light.weight[:, c]
                errors[:, c] = np.sqrt(np.maximum(np.sum(slope @ covariance[own, own] * slope, axis=1), 0))
            mean = light.energy.sum(0) / 2  # `energy` is over 2π, a mean over 4π
            maps[block.name] = np.minimum(errors / mean, LARGEST).reshape(ROWS, 2 * ROWS, 3)
        return maps


def in_gauge_of(errors: StandardErrors, fitted: Materials, materials: Materials) -> StandardErrors:
    """The errors of reflectances that were `fitted`, in the gauge in which they are those of `materials`."""
    diffuse = errors.materials.diffuse * materials.diffuse / fitted.diffuse
    specular = errors.materials.specular * materials.specular / fitted.specular
    return StandardErrors(Materials(diffuse, specular, errors.materials.roughness), errors.deviation)
