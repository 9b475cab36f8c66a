"""Standard errors of materials and lights in a fixed gauge, including errors of the model.

Materials   Let S be the materials' information with all lights and turns of poses eliminated.  Let s_k be the score of
            cluster k of observations: its part of the gradient, less the part that the lights absorb.  Residuals are
            whitened and divided by √T, so that for independent noise the covariance would be S⁻¹.  Too coarse cells,
            too few lobes or wrong normals make neighbouring residuals correlated.  The sandwich

                S⁻¹ (Σ_k s_k s_kᵀ · K/(K − 1)) S⁻¹                                                                   (1)

            allows any dependence within a cluster (Liang and Zeger 1986).  It is computed for two kinds of clusters.
            One is the light toward nearby mirror directions, a region whose bias all materials there share.  The other
            is a whole light, because an error everywhere in it is visible only in comparison with other lights.  The
            largest of the three variances is used, unknown by unknown.

Gauge       The data leave one factor per channel and component free, so an error is defined only once that factor is
            fixed.  Here the sum of diffuse and specular reflectance over a component's materials is fixed in each
            channel.  With g the direction of that factor and h the gradient of the fixed sum, covariances are projected
            by P = I − g hᵀ / (hᵀ g).  A known material or light fixes the factor and has no error, and nothing is
            projected.  Surfaces that light each other determine the factor too, but badly: on data/eames and similar
            synthetic sets it is off by 7 to 50 %.

Variables   S comes from the system of φ (`factorlib.inference.fit.likelihood`), with respect to reflectances: with
            respect to their logarithms, a zero reflectance would look exactly known.

Model       More observations do not remove errors of the model itself, mostly of the mesh.  MODEL_ERROR is therefore
            added in quadrature, in proportion to the residuals.

Blur        Normals that are wrong by s along each tangent spread a highlight as roughness does: the slopes of
            microfacets have the variance α²/2 along an axis (α = roughness²), and those of normals s².  So what is
            seen is α² + 2s², and roughness has the further error

                (roughness⁴ + 2s²)^¼ − roughness                                                                     (2)

            with s² the mean over the material's observations, by their information on roughness.  The prior may move
            a material along it; k_d and k_s follow as the observations demand.

Prior       `factorlib.inference.answer.material_posterior` combines this covariance with the prior on materials.

Lights      Given the materials, log radiance of a light has the covariance Σ = H⁻¹.  A map's radiance in direction d is
            Σ_p φ_p(d) w_p with w_p = peak_p exp(u_p).  Its variance is gᵀ Σ g with g_p = φ_p(d) w_p, plus the light's
            own model error LIGHT_ERROR.  In directions without information, Σ is the prior's covariance.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import msgspec
import numpy as np
from jaxtyping import Float
from scipy.stats import norm
from scipy.stats import t as student_t

from factorlib.conventions import YUP_FROM_CAMERA, lat_long_directions
from factorlib.inference.answer.material_posterior import material_posterior
from factorlib.inference.fit.fit import Fit, light_likelihood, reliable_observations
from factorlib.inference.fit.fit_runner import Solution
from factorlib.inference.fit.likelihood import (
    LightLikelihood,
    System,
    cholesky_factor,
    cholesky_inverse,
    solve_cholesky,
)
from factorlib.inference.model.gauge import connected_components
from factorlib.inference.model.material_prior import material_unknowns, materials_from_unknowns
from factorlib.inference.model.materials import (
    LEAST_REFLECTANCE,
    REFLECTANCES,
    ROUGHNESS,
    UNKNOWNS,
    MaterialErrors,
    Materials,
    Point,
)
from factorlib.inference.model.normal_errors import normal_variance
from factorlib.inference.model.problem import JointProblem
from factorlib.inference.options import SolveOptions
from factorlib.light.lobes import squared_distances
from factorlib.light.prior import LightPrior
from factorlib.robust import TINY, robust_deviation

GAUGE = "standard errors hold the sum of diffuse + specular over a component's materials fixed in each channel"
GIVEN = "; where a material or a light is known, that alone is fixed"
ABSOLUTE = (
    "; where surfaces light each other or photos show the surroundings, that sum is known too, but to about a "
    "quarter of itself only"
)
WIDTHS = (*[1.0] * REFLECTANCES, ROUGHNESS[1] - ROUGHNESS[0])  # widths of the ranges of a material's unknowns
# Standard deviations for residuals of one σ of the noise model, relative for k_d, k_s and lights, absolute for
# roughness.  With them about 68 % of true values lie within one standard error on the sets that
# settings were chosen on (`studies.measured.standard_errors`).
MODEL_ERROR = np.array([0.09] * 3 + [0.25] * 3 + [0.06])
LIGHT_ERROR = 0.7
COVERAGE_ROWS = 32  # rows of the maps of a light's relative standard errors
LARGEST_RELATIVE_ERROR = 1000.0  # upper limit in these maps


def estimate_uncertainty(
    solution: Solution, problem: JointProblem, options: SolveOptions, tick: Callable[[], None] = lambda: None
) -> tuple[MaterialErrors, dict[str, Float[np.ndarray, "h w 3"]]]:
    """Return the standard errors of the materials, scaled as the answer is, and maps of each light's relative errors.

    What is held fixed is the sum of the module docstring's paragraph on the gauge, and not the gauge of the answer.

    Args:
        solution: Result of the solver.
        problem: All observations of the solve.
        options: Options of the user.
        tick: Called after each system of a light, one or (for the paper's solver) two a light.
    """
    errors = solution.errors
    if not len(errors.materials):  # of the paper's solver, which has no prior
        sample = reliable_observations(solution.effective_problem(problem)).subsample(
            solution.observations, options.seed
        )
        errors = Posterior(sample, solution.materials, solution.prior, tick).standard_errors()
    else:
        problem = problem.with_all_fitted()
    # errors in proportion to reflectances, whose scale is that of the answer
    fitted = np.maximum(solution.fit.point.materials.rows(), LEAST_REFLECTANCE)
    in_gauge = errors.materials.rows() * (solution.point.materials.rows() / fitted)
    errors = msgspec.structs.replace(errors, materials=Materials.from_rows(in_gauge))
    light_sample = solution.light_sample(problem, options.seed)
    return errors, Posterior(light_sample, solution.fit, solution.prior, tick).relative_standard_errors()


class Posterior:
    """Posterior of materials and lights at the fit of a joint solve.

    Args:
        problem: Observations of the fit.
        fit: Fit of materials and lights.
        prior: Prior on lights.
        tick: Called after each light's system.
    """

    def __init__(self, problem: JointProblem, fit: Fit, prior: LightPrior, tick: Callable[[], None] = lambda: None):
        self.problem = problem
        self.fit = fit
        self.prior = prior
        self.tick = tick
        self.materials = materials_from_unknowns(material_unknowns(fit.point.materials))  # reflectances above zero

    def likelihoods(self, materials_given: bool = False) -> list[LightLikelihood]:
        """Return the likelihood of each illumination."""
        illuminations = self.problem.without_held_out().illuminations(Point(self.materials, self.fit.point.lights))
        build = partial(light_likelihood, prior=self.prior, materials_given=materials_given, tables=self.problem.tables)
        pairs = list(zip(illuminations, self.fit.hyperparameters, strict=True))
        return list(self.problem.spread(lambda pair: build(*pair), pairs))

    def systems(self, with_scores: bool) -> list[System]:
        """Return the system of φ of each illumination, with scores of clusters of observations if requested."""

        def system(likelihood: LightLikelihood) -> System:
            """Return the system of one illumination."""
            group = likelihood.illumination.block.clusters() if with_scores else None
            result = likelihood.normal_equations(determinants=False, group=group)
            self.tick()
            return result

        return list(self.problem.spread(system, self.likelihoods(not with_scores)))

    def blur(self) -> Float[np.ndarray, " m"]:
        """Return the error of each material's roughness by errors of normals, (2)."""
        roughness = self.materials.roughness
        total, weighted = np.zeros((2, len(roughness)))
        for likelihood in self.likelihoods():
            illumination = likelihood.illumination
            block = illumination.block
            # ∂r/∂roughness of each observation
            slope = illumination.predict().by_roughness * self.materials.specular[block.material] * block.inverse_sigma
            information = np.square(slope).sum(1)
            total += np.bincount(block.material, information, len(roughness))
            weighted += np.bincount(block.material, information * normal_variance(block), len(roughness))
        variance = weighted / np.maximum(total, TINY)
        return (roughness**4 + 2 * variance) ** 0.25 - roughness

    def covariances(self) -> tuple[Float[np.ndarray, "k k"], Float[np.ndarray, "k k"]]:
        """Return two covariances of reflectances and roughnesses, in the gauge.

        The first is that by the observations as the fit weighs them; the second the widest of it and (1).
        """
        materials = self.materials
        values = by_unknowns(materials).reshape(-1)
        # S and s_k, from logarithms to reflectances: ∂ log k/∂k = 1/k
        precision, scores = information(self.systems(with_scores=True), len(values))
        clusters = [light_scores / values for light_scores in scores]
        inverse = regularised_inverse(precision / np.outer(values, values), materials, self.problem)
        by_fit = project_to_gauge(inverse, materials, self.problem)
        return by_fit, widest_covariance(inverse, clusters, materials, self.problem)

    def standard_errors(self) -> MaterialErrors:
        """Return the standard error of every material unknown by the observations alone."""
        _, by_data = self.covariances()
        deviation = residual_deviation(self.problem, self.fit.point)
        free = self.problem.known.free(len(self.materials)).reshape(-1, UNKNOWNS)
        model_errors = free * deviation * MODEL_ERROR * by_unknowns(self.materials)
        model_errors[:, REFLECTANCES] = free[:, REFLECTANCES] * np.hypot(model_errors[:, REFLECTANCES], self.blur())
        # an error is at most the width of its unknown's range
        errors = np.minimum(np.hypot(np.sqrt(np.diag(by_data)).reshape(free.shape), model_errors), WIDTHS)
        return MaterialErrors(Materials.from_rows(errors), deviation, np.zeros_like(errors))

    def with_prior(self) -> tuple[Materials, MaterialErrors]:
        """Return the materials by `factorlib.inference.answer.material_posterior`, and their standard errors."""
        covariances = self.covariances()
        deviation = residual_deviation(self.problem, self.fit.point)
        values = by_unknowns(self.materials)
        unknowns = material_unknowns(self.materials)
        free = self.problem.known.free(len(unknowns)).reshape(-1, UNKNOWNS)
        # the part of MODEL_ERROR beyond 1 σ lets the prior move the estimate; its part up to 1 σ only widens the error
        noise = min(deviation, 1.0)
        excess = np.sqrt(deviation**2 - noise**2)
        posteriors = []
        blur = self.blur()
        for m, theta in enumerate(unknowns):
            rows = slice(UNKNOWNS * m, UNKNOWNS * (m + 1))
            fitted, data = (each[rows, rows] / np.outer(values[m], values[m]) for each in covariances)
            name = self.problem.known.classes.get(m)
            # the other unknowns follow roughness as the observations demand
            blurred = blur[m] * fitted[:, REFLECTANCES] / max(fitted[REFLECTANCES, REFLECTANCES], TINY)
            model = np.diag((excess * MODEL_ERROR) ** 2) + np.outer(blurred, blurred)
            posteriors.append(material_posterior(theta, fitted, data, model, free[m], name))
        materials = materials_from_unknowns(np.array([posterior.theta for posterior in posteriors]))
        deviations = np.hypot([posterior.deviation for posterior in posteriors], free * noise * MODEL_ERROR)
        errors = np.minimum(deviations * by_unknowns(materials), WIDTHS)
        shares = np.array([posterior.prior_share for posterior in posteriors])
        return materials, MaterialErrors(Materials.from_rows(errors), deviation, shares)

    def relative_standard_errors(self) -> dict[str, Float[np.ndarray, "h w 3"]]:
        """Return maps of each light's standard error relative to its mean radiance, by illumination.

        The maps are lat-long, of COVERAGE_ROWS rows, in the frame of the exported ones; values are at most
        LARGEST_RELATIVE_ERROR.
        """
        # directions of the maps' texels, in the frame of the blocks
        directions = (lat_long_directions(COVERAGE_ROWS, 2 * COVERAGE_ROWS) @ YUP_FROM_CAMERA).reshape(-1, 3)
        maps = {}
        model_error = residual_deviation(self.problem, self.fit.point) * LIGHT_ERROR
        for block, light, system in zip(
            self.problem.blocks, self.fit.point.lights, self.systems(with_scores=False), strict=True
        ):
            free = light.free
            errors = np.empty((len(directions), 3))
            p = int(free.sum())
            covariance = cholesky_inverse(system.factor[: light.integrated, : light.integrated])
            overlap = np.exp(-0.5 * light.sharpness * squared_distances(directions, light.axis))
            for c in range(3):
                cells = slice(c * p, (c + 1) * p)
                slope = (overlap * light.weight[:, c])[:, free]
                # gᵀ Σ g plus LIGHT_ERROR in quadrature
                variance = np.maximum(np.sum(slope @ covariance[cells, cells] * slope, axis=1), 0)
                errors[:, c] = np.hypot(np.sqrt(variance), model_error * slope.sum(1))
            maps[block.name] = np.minimum(errors / light.mean_radiance, LARGEST_RELATIVE_ERROR).reshape(
                COVERAGE_ROWS, 2 * COVERAGE_ROWS, 3
            )
        return maps


def by_unknowns(materials: Materials) -> Float[np.ndarray, "m 7"]:
    """Return the derivatives of reflectances and roughness by the fit's unknowns: the reflectances, and 1."""
    return np.column_stack([materials.diffuse, materials.specular, np.ones(len(materials))])


def information(
    systems: Sequence[System], size: int
) -> tuple[Float[np.ndarray, "k k"], list[Float[np.ndarray, "g k"]]]:
    """Return the materials' information and the scores of groups, with the lights eliminated.

    Args:
        systems: Contribution of each light.
        size: Number of material unknowns.

    Returns:
        S [size, size], and for each light its scores [g, size], less the part that the light absorbs.
    """
    hessian = np.zeros((size, size))
    scores = []
    for part in systems:
        coupling = solve_cholesky(part.factor, part.cross_hessian.T)
        # Σ M − C_i L_i⁻¹ C_iᵀ
        hessian[np.ix_(part.places, part.places)] += part.material_hessian - part.cross_hessian @ coupling
        k = len(part.places)
        # s_m − s_l L_i⁻¹ C_iᵀ
        scores.append(np.zeros((len(part.scores), size)))
        scores[-1][:, part.places] = part.scores[:, :k] - part.scores[:, k:] @ coupling
    return (hessian + hessian.T) / 2, scores


def residual_deviation(problem: JointProblem, point: Point) -> float:
    """Return the robust standard deviation of the whitened residuals.

    Clipped values are left out, because a satisfied bound has no residual.
    """
    pairs = list(zip(problem.residuals(point), problem.blocks, strict=True))
    residuals = np.concatenate([residual[~block.clipped] for residual, block in pairs])
    return robust_deviation(residuals if len(residuals) else np.concatenate([residual for residual, _ in pairs]))


def regularised_inverse(
    information: Float[np.ndarray, "k k"], materials: Materials, problem: JointProblem
) -> Float[np.ndarray, "k k"]:
    """Return the covariance S⁻¹ of independent noise; 0 for known unknowns.

    The data may leave unknowns undetermined, such as the roughness of a Lambertian material, or a trade of one unknown
    for another.  The variance of such an unknown is that of the width of its range, which counts as one more
    observation.

    Args:
        information: S of the materials; rounding may leave an eigenvalue below 0.
        materials: Estimated materials.
        problem: Observations.
    """
    free = problem.known.free(len(materials))
    inverse = np.zeros_like(information)
    scale = np.sqrt(np.maximum(np.diag(information)[free], 1.0))  # rows have different units
    scales = np.outer(scale, scale)
    # S, made positive definite by the ranges of the unknowns, and its inverse
    values, vectors = np.linalg.eigh(information[np.ix_(free, free)] / scales)
    regularised = (vectors * np.maximum(values, 0.0)) @ vectors.T + np.diag(
        np.tile(WIDTHS, len(materials))[free] ** -2.0 / scale**2
    )
    inverse[np.ix_(free, free)] = cholesky_inverse(cholesky_factor(regularised)) / scales
    return inverse


def widest_covariance(
    inverse: Float[np.ndarray, "k k"],
    scores: Sequence[Float[np.ndarray, "g k"]],
    materials: Materials,
    problem: JointProblem,
) -> Float[np.ndarray, "k k"]:
    """Return the covariance in the gauge with the largest of three variances of each unknown; 0 for known ones.

    Correlations are those of independent noise.

    Args:
        inverse: Covariance of independent noise.
        scores: s_k of each light's clusters, with the lights eliminated.
        materials: Estimated materials.
        problem: Observations.
    """
    light_sums = np.array([s.sum(0) for s in scores])
    covariances = inverse, sandwich(inverse, np.vstack(scores)), sandwich(inverse, light_sums)
    in_gauge = [project_to_gauge(covariance, materials, problem) for covariance in covariances]
    variances = np.array([np.diag(covariance) for covariance in in_gauge]).clip(0)
    deviation = np.sqrt(variances)
    scale = np.where(deviation[0] > 0, deviation.max(0) / np.where(deviation[0] > 0, deviation[0], 1.0), 0.0)
    covariance = in_gauge[0] * np.outer(scale, scale)
    np.fill_diagonal(covariance, variances.max(0))
    return covariance


def sandwich(inverse: Float[np.ndarray, "k k"], scores: Float[np.ndarray, "g k"]) -> Float[np.ndarray, "k k"]:
    """Return the sandwich covariance (1) from the scores of clusters, with the lights eliminated, one a row.

    It is widened by Student's t for the number of clusters, and zero for fewer than two.
    """
    count = len(scores)
    if count < 2:
        return np.zeros_like(inverse)
    # S⁻¹ (Σ_k s_k s_kᵀ · K/(K − 1)) S⁻¹, (1), times the squared t quantile of one standard deviation
    quantile = float(student_t.ppf(norm.cdf(1), count - 1))
    return quantile**2 * inverse @ (scores.T @ scores) @ inverse * count / (count - 1)


def project_to_gauge(
    covariance: Float[np.ndarray, "k k"], materials: Materials, problem: JointProblem
) -> Float[np.ndarray, "k k"]:
    """Return the covariance with the sum of each component fixed in as many channels as have a free factor.

    Args:
        covariance: Covariance of all material unknowns.
        materials: Estimated materials.
        problem: Observations.
    """
    rows = materials.rows()
    for members, illuminations in connected_components(problem.blocks, len(materials)):
        factors = problem.known.free_factors(members, illuminations)
        for columns in {3: [[0, 3], [1, 4], [2, 5]], 1: [[*range(6)]], 0: []}[factors]:
            g = np.zeros(rows.shape)
            h = np.zeros(rows.shape)
            entries = np.ix_(members, columns)
            g[entries] = rows[entries]
            h[entries] = 1
            # P = I − g hᵀ / (hᵀ g)
            P = np.eye(rows.size) - np.outer(g, h) / np.vdot(h, g)
            covariance = P @ covariance @ P.T
    return covariance
