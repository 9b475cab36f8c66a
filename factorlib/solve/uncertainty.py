"""Standard errors of the materials, honest about what the model cannot say, in a fixed gauge.

With all lights eliminated, S is the materials' information and s_k the score of cluster k of observations: its part of
the gradient, less what the lights take up of it.  Were residuals independent noise, the covariance would be σ² S⁻¹.
They are not: where a light has fewer lobes than it has features, or normals are wrong, neighbouring pixels err alike.
The sandwich

    S⁻¹ (Σ_k s_k s_kᵀ · K/(K − 1)) S⁻¹                                                                     (1)

lets residuals within a cluster depend on each other in any way (Liang and Zeger 1986).  It is taken over two kinds of
clusters.  One is what a light sends toward nearby mirror directions: a region of the light, whose bias all materials there
share.  The other is a whole light: with few lobes it is wrong everywhere in ways that lean together, and only other lights
tell.  The largest of the three variances is taken, unknown by unknown.

Scores are those of residuals up to the noise model's σ at least, where the answer was found with a narrower robust scale: what it set
aside as an outlier is a part of the light that its lobes do not show, and by how much that would move the materials is what they are
uncertain by.

The data leave one factor per channel and component free, so an error is only defined once that factor is fixed.
Here the sum of diffuse and specular reflectance over a component's materials is held in each channel: with g the
direction of that factor and h the gradient of the held sum, covariances are projected by P = I − g hᵀ / (hᵀ g).
"""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import cho_factor, cho_solve
from scipy.stats import norm
from scipy.stats import t as student_t

from factorlib.solve.normal_equations import Loss, System, predicted_radiance, residuals, system
from factorlib.solve.problem import Block, connected_components, mirror_cells
from factorlib.solve.step import damped, held_unknowns, masked, schur_complement
from factorlib.solve.unknowns import ROUGHNESS, Light, Materials

GAUGE = "standard errors hold the sum of diffuse + specular over a component's materials fixed in each channel"
WIDTHS = (*[1.0] * 6, ROUGHNESS[1] - ROUGHNESS[0])  # of the ranges of a material's unknowns
LEAST_DEVIATION = 1e-4  # of the noise model: what a single observation is explained to says nothing
CLUSTER = 0.35  # size of a cluster's cell of mirror directions: 20°


def standard_errors(blocks: Sequence[Block], solution, operator, loss: Loss) -> tuple[Materials, float]:
    """Standard error of every material unknown, and the residual's standard deviation in units of the noise model.

    solution: a `descent.Solution` of these blocks;  loss: that it minimises
    What the data do not see, one unknown as the roughness of a matte material or a trade of one for another, is uncertain by
    the width of its range, which counts as one more observation of each unknown.
    """
    materials, lights = solution.materials, solution.lights
    sigma = max(residual_deviation(blocks, materials, lights, operator), LEAST_DEVIATION)
    loss = msgspec.structs.replace(loss, robust_scale=max(loss.robust_scale, 1.0))
    systems = [
        system(block, light, materials, operator, loss, clusters_of(block)) for block, light in zip(blocks, lights, strict=True)
    ]
    information = schur_complement(systems, materials, lights)
    widths = np.tile(WIDTHS, len(materials))
    inverse = _inverse(information / sigma**2 + np.diag(widths**-2.0))  # nothing is less known than its range says
    by_cell = [reduced_scores(s, light, materials) for s, light in zip(systems, lights, strict=True)]
    covariances = inverse, _sandwich(inverse, np.vstack(by_cell), sigma), _sandwich(inverse, np.array([s.sum(0) for s in by_cell]), sigma)
    variances = [np.diag(in_gauge(covariance, materials, blocks)) for covariance in covariances]
    errors = np.minimum(np.sqrt(np.max(variances, axis=0).clip(0)), widths).reshape(-1, 7)
    return Materials(errors[:, :3], errors[:, 3:6], errors[:, 6]), sigma


def _sandwich(inverse: Float[np.ndarray, "k k"], scores: Float[np.ndarray, "g k"], sigma: float) -> Float[np.ndarray, "k k"]:
    """(1), as wide as Student's t asks for so few clusters."""
    count = len(scores)
    if count < 2:
        return np.zeros_like(inverse)
    few = float(student_t.ppf(norm.cdf(1), count - 1))
    return few**2 * inverse @ (scores.T @ scores) @ inverse * count / (count - 1) / sigma**4


def clusters_of(block: Block) -> Int[np.ndarray, "n"]:
    """The number of each observation's cluster."""
    return np.unique(mirror_cells(block.normal, block.view, CLUSTER), return_inverse=True)[1].reshape(-1)


def reduced_scores(s: System, light: Light, materials: Materials) -> Float[np.ndarray, "k 7m"]:
    """Scores with this light eliminated."""
    m = len(s.material_gradient)
    loose = ~held_unknowns(light, materials, s.light_gradient)
    factor = cho_factor(masked(damped(s.light_hessian, 1e-9), loose), check_finite=False)
    return s.scores[:, :m] - (s.scores[:, m:] * loose) @ cho_solve(factor, (s.cross_hessian * loose).T, check_finite=False)


def residual_deviation(blocks: Sequence[Block], materials: Materials, lights: Sequence[Light], operator) -> float:
    """Robust standard deviation of the whitened residuals."""
    every = [residuals(b, predicted_radiance(b, light, materials, operator)) for b, light in zip(blocks, lights, strict=True)]
    return 1.4826 * float(np.median(np.abs(np.concatenate(every))))


def in_gauge(covariance: Float[np.ndarray, "k k"], materials: Materials, blocks: Sequence[Block]) -> Float[np.ndarray, "k k"]:
    """The covariance where the sum of each component and channel is held."""
    for members, _ in connected_components(blocks, len(materials)):
        for channel in range(3):
            project = _gauge_projection(materials, members, channel)
            covariance = project @ covariance @ project.T
    return covariance


def _gauge_projection(materials: Materials, members: Sequence[int], channel: int) -> Float[np.ndarray, "7m 7m"]:
    direction, held = np.zeros(7 * len(materials)), np.zeros(7 * len(materials))
    for m in members:
        direction[7 * m + channel], direction[7 * m + 3 + channel] = materials.diffuse[m, channel], materials.specular[m, channel]
        held[[7 * m + channel, 7 * m + 3 + channel]] = 1
    return np.eye(len(direction)) - np.outer(direction, held) / (held @ direction)


def _inverse(matrix: Float[np.ndarray, "k k"]) -> Float[np.ndarray, "k k"]:
    """Of a symmetric positive definite matrix whose rows are of unlike units."""
    scale = 1 / np.sqrt(np.diag(matrix))
    return cho_solve(cho_factor(matrix * np.outer(scale, scale)), np.diag(scale)) * scale[:, None]
