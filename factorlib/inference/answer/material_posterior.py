"""Posterior of each material from its estimate, the errors of the model, and the prior on materials.

A fit weighs observations as if the model were exact but for independent noise, so that a wrong mesh can outweigh any
prior: stone becomes enamel.  Once the errors of the model are known (`factorlib.inference.answer.uncertainty`), each
material is estimated again.  Let θ = (log k_d, log k_s, roughness), θ̂ the fit, A⁻¹ its covariance as the fit weighs
its observations, and M that of errors of the model.  p is the mixture of classes of
`factorlib.inference.model.material_prior`.  θ minimises

    (θ − θ₀)ᵀ (A⁻¹ + M)⁻¹ (θ − θ₀) − 2 log p(log k_s, roughness),    θ₀ = θ̂ + A⁻¹ g                                 (1)

with g half the gradient of −2 log p at θ̂.  θ̂ already weighs the prior against A, so that A (θ̂ − θ₀) + g = 0, and θ₀ is
the estimate of the observations without it.  So without errors of the model (M = 0) θ̂ stays.  A⁻¹ couples k_d to k_s,
so k_d follows.  Standard errors are wider: in them S, the widest estimate of the covariance by the observations, takes
the place of A⁻¹.  S is an upper bound from few clusters, by which an estimate would leave what is observed.  The
covariance is ((S + M)⁻¹ + P)⁻¹, with P half the Hessian of −2 log p.  The share of an unknown that comes from the prior
is one less the ratio of its variance to that in S + M.  The mixture is without ε, which is a term of the fit.  Here it
would move sums of k_d and k_s that the observations determine.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import minimize

from factorlib.inference.model.material_prior import Mixture, classes_of
from factorlib.inference.model.materials import LEAST_REFLECTANCE, REFLECTANCES, ROUGHNESS, UNKNOWNS

BOUNDS = [(float(np.log(LEAST_REFLECTANCE)), 0.0)] * REFLECTANCES + [ROUGHNESS]
# Largest standard deviation of an unknown in S and A⁻¹: that of the logarithm of a reflectance near 0 is without limit.
LARGEST_DEVIATION = 2.0
LEAST_DEVIATION = 1e-6  # least standard deviation in them, so that S has an inverse


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
    fitted: Float[np.ndarray, "7"],
    fit_covariance: Float[np.ndarray, "7 7"],
    covariance: Float[np.ndarray, "7 7"],
    model_covariance: Float[np.ndarray, "7 7"],
    free: Bool[np.ndarray, "7"],
    name: str | None = None,
) -> MaterialPosterior:
    """Return the posterior of one material by (1).

    Args:
        fitted: θ̂.
        fit_covariance: A⁻¹.
        covariance: S.
        model_covariance: M.
        free: Mask of the unknowns to be estimated.
        name: Class of the material, if the user named it.
    """
    deviation = np.where(free, np.sqrt(np.diag(covariance + model_covariance)), 0.0)
    if not free[3:].any():
        return MaterialPosterior(fitted, deviation, np.zeros(UNKNOWNS))
    mixture = Mixture(classes_of(name), one_tint=False)
    # θ₀ and (A⁻¹ + M)⁻¹ of (1)
    spread = limit_deviations(fit_covariance)
    center = fitted + np.where(free, spread @ (free * mixture.evaluate(fitted)[1]), 0.0)
    precision = np.linalg.inv((spread + model_covariance)[np.ix_(free, free)])
    bounds = [(low, max(high, fitted[k])) for k, (low, high) in enumerate(BOUNDS) if free[k]]

    def objective(unknowns: np.ndarray) -> tuple[float, np.ndarray]:
        """Return (1) and its gradient by the free unknowns."""
        full = fitted.copy()
        full[free] = unknowns
        off = unknowns - center[free]
        energy, slope, _, _ = mixture.evaluate(full)
        return float(off @ precision @ off) + energy, 2 * (precision @ off + slope[free])

    # (1) has several minima.  A⁻¹ is valid near the fit only, so classes are other starts only where M exceeds it
    far = (np.diag(model_covariance) > np.diag(fit_covariance))[3:].any()
    starts = [fitted, *(np.append(fitted[:3], mean) for mean in mixture.mean if far)]
    minima = [minimize(objective, start[free], jac=True, method="L-BFGS-B", bounds=bounds) for start in starts]
    result = fitted.copy()
    result[free] = min(minima, key=lambda minimum: minimum.fun).x
    # ((S + M)⁻¹ + P)⁻¹
    limited = limit_deviations(covariance) + model_covariance
    rows = np.ix_(free, free)
    variance = np.zeros(UNKNOWNS)
    variance[free] = np.diag(np.linalg.inv(np.linalg.inv(limited[rows]) + mixture.evaluate(result)[2][rows]))
    share = np.where(free, 1 - variance / np.diag(limited), 0.0).clip(0, 1)
    # no prior bears on k_d, whose deviation is therefore not limited
    posterior_deviation = np.where(np.arange(UNKNOWNS) < 3, deviation * np.sqrt(1 - share), np.sqrt(variance))
    return MaterialPosterior(result, posterior_deviation, share)


def limit_deviations(covariance: Float[np.ndarray, "7 7"]) -> Float[np.ndarray, "7 7"]:
    """Return a covariance with deviations between `LEAST_DEVIATION` and `LARGEST_DEVIATION`."""
    scale = np.minimum(1.0, LARGEST_DEVIATION / np.maximum(np.sqrt(np.diag(covariance)), LEAST_DEVIATION))
    return covariance * np.outer(scale, scale) + LEAST_DEVIATION**2 * np.eye(UNKNOWNS)
