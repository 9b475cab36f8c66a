"""Standard errors of materials under lights of few lobes, honest about what the model cannot say, in a fixed gauge.

With all lights eliminated, S is the materials' information and s_k the score of cluster k of observations: its part of
the gradient, less what the lights take up of it.  Were residuals independent noise, the covariance would be σ² S⁻¹.
They are not: where a light has fewer lobes than it has features, or normals are wrong, neighbouring pixels err alike.
The sandwich

    S⁻¹ (Σ_k s_k s_kᵀ · K/(K − 1)) S⁻¹                                                                     (1)

lets residuals within a cluster depend on each other in any way (Liang and Zeger 1986).  It is taken over two kinds of
clusters.  One is what a light sends toward nearby mirror directions: a region of the light, whose bias all materials there
share.  The other is a whole light: with few lobes it is wrong everywhere in ways that agree, and only other lights
show it.  The largest of the three variances is taken, unknown by unknown.

The robust scale of scores is the noise model's σ at least, even where the answer was found with a narrower one.  What the narrow scale
treats as outliers are parts of the light that the lobes do not show, and how far these would move the materials is their uncertainty.

The data leave one factor per channel and component free, so an error is only defined once that factor is fixed.
Here the sum of diffuse and specular reflectance over a component's materials is fixed in each channel: with g the
direction of that factor and h the gradient of the fixed sum, covariances are projected by P = I − g hᵀ / (hᵀ g).
A component in which surfaces light each other has no free factor: its errors are of absolute reflectances.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import msgspec
import numpy as np
from jaxtyping import Float
from scipy.stats import norm
from scipy.stats import t as student_t

from factorlib.model.blocks import Block
from factorlib.model.bounds import ROUGHNESS
from factorlib.model.clusters import clusters_of
from factorlib.model.components import connected_components
from factorlib.model.gauge import is_free
from factorlib.model.illumination import Illumination
from factorlib.model.loss import Loss
from factorlib.model.materials import Materials
from factorlib.model.point import Point
from factorlib.model.problem import JointProblem
from factorlib.robust import robust_deviation
from factorlib.solve.few_lobes.arrow import ArrowSystem
from factorlib.solve.few_lobes.normal_equations import NormalEquations, normal_equations
from factorlib.solve.marginal import positive_definite_inverse

GAUGE = "standard errors hold the sum of diffuse + specular over a component's materials fixed in each channel"
ABSOLUTE = "; in components with interreflection nothing is held fixed"
WIDTHS = (*[1.0] * 6, ROUGHNESS[1] - ROUGHNESS[0])  # of the ranges of a material's unknowns
LEAST_DEVIATION = 1e-4  # of the noise model: what a single observation is explained to says nothing


class StandardErrors(NamedTuple):
    """Of every material unknown; deviation: standard deviation of the residuals in units of the noise model."""

    materials: Materials
    deviation: float


def standard_errors(problem: JointProblem, point: Point) -> StandardErrors:
    """Standard error of every material unknown, at a point that minimises the problem's loss.

    What the data do not see, one unknown as the roughness of a Lambertian material or a trade of one for another, is uncertain by
    the width of its range, which counts as one more observation of each unknown.
    """
    materials, count = point.materials, len(point.materials)
    sigma = max(residual_deviation(problem, point), LEAST_DEVIATION)
    loss = msgspec.structs.replace(problem.loss, robust_scale=max(problem.loss.robust_scale, 1.0))
    parts = problem.spread(partial(clustered_equations, loss=loss), problem.illuminations(point))
    system = ArrowSystem(list(parts), 7 * count)
    information, widths = system.schur_complement(point), np.tile(WIDTHS, count)
    inverse = inverse_of(information / sigma**2 + np.diag(widths**-2.0))  # nothing is less known than its range says
    by_cell = system.reduced_scores(point)
    covariances = (
        inverse,
        sandwich(inverse, np.vstack(by_cell), sigma),
        sandwich(inverse, np.array([s.sum(0) for s in by_cell]), sigma),
    )
    variances = [np.diag(in_gauge(covariance, materials, problem.blocks)) for covariance in covariances]
    errors = np.minimum(np.sqrt(np.max(variances, axis=0).clip(0)), widths).reshape(-1, 7)
    return StandardErrors(Materials(errors[:, :3], errors[:, 3:6], errors[:, 6]), sigma)


def clustered_equations(illumination: Illumination, loss: Loss) -> NormalEquations:
    """Normal equations with the scores of clusters of mirror directions."""
    return normal_equations(illumination, loss, clusters_of(illumination.block))


def sandwich(
    inverse: Float[np.ndarray, "k k"], scores: Float[np.ndarray, "g k"], sigma: float
) -> Float[np.ndarray, "k k"]:
    """(1) from scores that lights were eliminated from, one a row, as wide as Student's t asks for so few clusters."""
    count = len(scores)
    if count < 2:
        return np.zeros_like(inverse)
    few = float(student_t.ppf(norm.cdf(1), count - 1))
    return few**2 * inverse @ (scores.T @ scores) @ inverse * count / (count - 1) / sigma**4


def residual_deviation(problem: JointProblem, point: Point) -> float:
    """Robust standard deviation of the whitened residuals."""
    return robust_deviation(np.concatenate(problem.residuals(point)))


def in_gauge(
    covariance: Float[np.ndarray, "k k"], materials: Materials, blocks: Sequence[Block]
) -> Float[np.ndarray, "k k"]:
    """The covariance where the sum of each component and channel that has a free factor is fixed."""
    for members, illuminations in connected_components(blocks, len(materials)):
        for channel in range(3) if is_free(blocks, illuminations) else ():
            project = _gauge_projection(materials, members, channel)
            covariance = project @ covariance @ project.T
    return covariance


def _gauge_projection(materials: Materials, members: Sequence[int], channel: int) -> Float[np.ndarray, "7m 7m"]:
    direction, fixed = np.zeros(7 * len(materials)), np.zeros(7 * len(materials))
    for m in members:
        direction[7 * m + channel], direction[7 * m + 3 + channel] = (
            materials.diffuse[m, channel],
            materials.specular[m, channel],
        )
        fixed[[7 * m + channel, 7 * m + 3 + channel]] = 1
    return np.eye(len(direction)) - np.outer(direction, fixed) / (fixed @ direction)


def inverse_of(matrix: Float[np.ndarray, "k k"]) -> Float[np.ndarray, "k k"]:
    """Of a symmetric positive definite matrix whose rows are of unlike units."""
    scale = 1 / np.sqrt(np.diag(matrix))
    return positive_definite_inverse(matrix * np.outer(scale, scale)).matrix * np.outer(scale, scale)
