"""Standard errors of materials and lights that were found with a prior on lights (`factorlib.solve.natural`).

Materials   The information is the Schur complement of the marginal likelihood's system, by reflectances instead of their logarithms, of
            which a nil reflectance would seem to be known for sure.  As in `factorlib.diagnose.uncertainty` its
            inverse and two sandwiches, over clusters of mirror directions and over whole lights, are compared, and the largest counts.
            The prior on k_s is left out: standard errors say what the observations alone determine.
            What the model itself has wrong, mostly the mesh, more observations do not mend: MODEL_ERROR is added in quadrature.
Lights      Given the materials, log radiance has covariance Σ = H⁻¹ (equation (1) of `factorlib.solve.marginal`).  A map's radiance in
            direction d is Σ_p φ_p(d) w_p with w = exp(u), so its variance is gᵀ Σ g with g_p = φ_p(d) w_p.  Where no observation tells
            anything, Σ is the prior's covariance.
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
from factorlib.model.cells import clusters_of
from factorlib.model.materials import Materials
from factorlib.model.problem import JointProblem
from factorlib.solve.cholesky import positive_definite_inverse
from factorlib.solve.lattice import Lattice
from factorlib.solve.marginal import Field, Marginal, marginal
from factorlib.solve.marginal_descent import materials_of, unknowns_of
from factorlib.solve.natural import Natural, fields_of

# Standard deviations, relative of k_d and k_s, absolute of roughness: with them about 70 % of true values lie within one standard error on
# sets that settings were chosen on (data/eames and the eames-like sets of seeds 11 and 13; without, 62, 51 and 27 %).  Lights follow the
# prior only where the model explains photographs badly, so they are never added to what is exact.
MODEL_ERROR = np.array([0.03] * 3 + [0.15] * 3 + [0.03])


class Posterior:
    """What is uncertain at an answer with a prior on lights; problem: what it was fitted to."""

    def __init__(self, problem: JointProblem, answer: Natural, prior: LightPrior):
        self.problem, self.answer = problem, answer
        self.lattice = Lattice.of(answer.log_radiance[0].shape[1])
        self.materials = materials_of(unknowns_of(answer.point.materials))  # none of whose reflectances is nil
        self.fields = fields_of(problem, answer.point, prior, self.lattice, answer.hyperparameters)

    def systems(self, with_scores: bool) -> list[Marginal]:
        """Of each illumination; with_scores: of clusters of observations, too; without, materials are given."""

        def system(one: tuple[Field, np.ndarray]) -> Marginal:
            """Of one illumination and its light."""
            field, log_radiance = one
            return marginal(field, log_radiance, self.materials, clusters_of(field.block) if with_scores else None, not with_scores)

        return list(self.problem.spread(system, list(zip(self.fields, self.answer.log_radiance, strict=True))))

    def standard_errors(self) -> StandardErrors:
        """Standard error of every material unknown."""
        materials, blocks = self.materials, self.problem.blocks
        count, widths = 7 * len(materials), np.tile(WIDTHS, len(materials))
        by_log = 1 / np.column_stack([materials.diffuse, materials.specular, np.ones(len(materials))]).reshape(-1)  # ∂ log k/∂k
        information, scores = np.diag(widths**-2.0), []  # nothing is less known than its range says
        for system in self.systems(with_scores=True):
            taken_up = cho_solve(cho_factor(system.light_hessian), system.cross_hessian.T)  # by the light
            information = information + (system.material_hessian - system.cross_hessian @ taken_up) * np.outer(by_log, by_log)
            scores.append((system.scores[:, :count] - system.scores[:, count:] @ taken_up) * by_log)
        inverse = inverse_of(information)
        covariances = inverse, sandwich(inverse, np.vstack(scores), 1.0), sandwich(inverse, np.array([s.sum(0) for s in scores]), 1.0)
        variances = [np.diag(in_gauge(covariance, materials, blocks)) for covariance in covariances]
        model_error = (MODEL_ERROR * np.column_stack([materials.diffuse, materials.specular, np.ones(len(materials))])).reshape(-1)
        errors = np.minimum(np.sqrt(np.max(variances, axis=0).clip(0) + model_error**2), widths).reshape(-1, 7)
        deviation = residual_deviation(self.problem, self.answer.point)
        return StandardErrors(Materials(errors[:, :3], errors[:, 3:6], errors[:, 6]), deviation)

    def relative_standard_errors(self) -> dict[str, Float[np.ndarray, "h w 3"]]:
        """By illumination, over the light's mean radiance: a small lat-long map in the frame of the exported ones, at most LARGEST."""
        lattice, p = self.lattice, len(self.lattice)
        directions = (lat_long_directions(ROWS, 2 * ROWS) @ YUP_FROM_CAMERA).reshape(-1, 3)
        overlap = np.exp(-0.5 * lattice.sharpness * squared_distances(directions, lattice.axis))
        maps = {}
        for field, system, log_radiance in zip(self.fields, self.systems(with_scores=False), self.answer.log_radiance, strict=True):
            covariance = positive_definite_inverse(system.light_hessian).matrix
            errors = np.empty((len(directions), 3))
            for c in range(3):
                own, slope = slice(c * p, (c + 1) * p), overlap * lattice.weight(log_radiance)[:, c]
                errors[:, c] = np.sqrt(np.maximum(np.sum(slope @ covariance[own, own] * slope, axis=1), 0))
            mean = np.exp(log_radiance).mean(1)
            maps[field.block.name] = np.minimum(errors / mean, LARGEST).reshape(ROWS, 2 * ROWS, 3)
        return maps
