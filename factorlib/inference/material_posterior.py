"""Posterior of each material from its estimate, the errors of the model, and the prior on materials.

A fit weighs observations as if the model were exact but for independent noise, so that a wrong mesh can outweigh any
prior: stone becomes enamel.  Once the errors of the model are known (`factorlib.inference.uncertainty`), each material
is estimated again.  With θ = (log k_d, log k_s, roughness), θ̂ the fit and Σ its covariance, errors of the model
included, it minimises

    (θ − θ̂)ᵀ Σ⁻¹ (θ − θ̂) − 2 log p(log k_s, roughness)                                                              (1)

with p the classes of `factorlib.inference.material_prior`.  Σ couples k_d to k_s, so k_d follows.  Its covariance is
(Σ⁻¹ + P)⁻¹, with P half the Hessian of −2 log p.  The share of an unknown that comes from the prior is one less the
ratio of its two variances.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import minimize

from factorlib.inference.material_prior import Mixture, classes_of
from factorlib.inference.materials import LEAST_REFLECTANCE, ROUGHNESS

BOUNDS = [(float(np.log(LEAST_REFLECTANCE)), 0.0)] * 6 + [ROUGHNESS]
# Largest standard deviation of an unknown in Σ: that of the logarithm of a reflectance near 0 is without limit.
LARGEST_DEVIATION = 2.0
LEAST_DEVIATION = 1e-6  # least standard deviation there, so that Σ has an inverse


class MaterialPosterior(NamedTuple):
    """Posterior of one material.

    Attributes:
        theta: Minimum of (1).
        deviation: Standard deviation of each unknown.
        prior_share: Share of each unknown that comes from the prior, 0 to 1.
    """

    theta: Float[np.ndarray, "7"]
    deviation: Float[np.ndarray, "7"]
    prior_share: Float[np.ndarray, "7"]


def material_posterior(
    theta: Float[np.ndarray, "7"], covariance: Float[np.ndarray, "7 7"], free: Bool[np.ndarray, "7"], name: str | None = None
) -> MaterialPosterior:
    """Return the posterior of one material by (1).

    Args:
        theta: θ̂.
        covariance: Σ.
        free: Mask of the unknowns that are not known.
        name: Class of the material, if the user named it.
    """
    deviation = np.where(free, np.sqrt(np.diag(covariance)), 0.0)
    if not free[3:].any():
        return MaterialPosterior(theta, deviation, np.zeros(7))
    mixture = Mixture(classes_of(name))
    # Σ with limited deviations
    scale = np.minimum(1.0, LARGEST_DEVIATION / np.maximum(deviation, LEAST_DEVIATION))
    limited = covariance * np.outer(scale, scale) + LEAST_DEVIATION**2 * np.eye(7)
    precision = np.linalg.inv(limited[np.ix_(free, free)])
    bounds = [(low, max(high, value)) for (low, high), value in zip(BOUNDS, theta, strict=True)]
    free_bounds = [bounds[k] for k in np.flatnonzero(free)]

    def objective(unknowns: np.ndarray) -> tuple[float, np.ndarray]:
        """Return (1) and its gradient by the free unknowns."""
        full = theta.copy()
        full[free] = unknowns
        off = unknowns - theta[free]
        energy, slope, _, _ = mixture.evaluate(full[3:])
        gradient = np.append(np.zeros(3), slope)[free]
        return float(off @ precision @ off) + energy, 2 * (precision @ off + gradient)

    # (1) has several minima: one start is the fit, the others have the means of the classes
    starts = [theta, *(np.append(theta[:3], mean) for mean in mixture.mean)]
    minima = [minimize(objective, start[free], jac=True, method="L-BFGS-B", bounds=free_bounds) for start in starts]
    result = theta.copy()
    result[free] = min(minima, key=lambda minimum: minimum.fun).x
    by_prior = np.zeros((7, 7))
    by_prior[3:, 3:] = mixture.evaluate(result[3:])[2]
    variance = np.zeros(7)
    variance[free] = np.diag(np.linalg.inv(precision + by_prior[np.ix_(free, free)]))
    share = np.where(free, 1 - variance / np.diag(limited), 0.0).clip(0, 1)
    # no prior bears on k_d, whose deviation is therefore not limited
    posterior_deviation = np.where(np.arange(7) < 3, deviation * np.sqrt(1 - share), np.sqrt(variance))
    return MaterialPosterior(result, posterior_deviation, share)
