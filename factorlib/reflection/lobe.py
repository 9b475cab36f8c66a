"""Moments of a light lobe exp(λ(ω·z − 1)) on the sphere, stable in float32 for every sharpness λ ≥ 0.

integral    E = 2π (1 − e^{−2λ}) / λ            4π at λ = 0
mean        t̄ = E[ω·z] = coth λ − 1/λ           0 at λ = 0, 1 as λ → ∞
variance    v∥ = 1 − t̄² − 2 t̄/λ along z, v⊥ = (1 − E[(ω·z)²])/2 = t̄/λ in each direction across
"""

from __future__ import annotations

import math

import torch
from torch import Tensor


def lobe_integral(sharpness: Tensor) -> Tensor:
    """Return ∫ exp(λ(ω·z − 1)) dω over the sphere, in steradians.

    >>> round(float(lobe_integral(torch.tensor(1e-9))) / math.pi, 5)
    4.0
    """
    return 2 * math.pi / gaussian_sharpness(sharpness)


def gaussian_sharpness(sharpness: Tensor) -> Tensor:
    """Return λ' = λ / (1 − e^{−2λ}), the sharpness of the plane Gaussian with the lobe's integral and peak.

    It is ½ at λ = 0.
    """
    small = sharpness < 1e-2
    safe = torch.where(small, torch.ones_like(sharpness), sharpness)
    series = 0.5 + sharpness / 2 + sharpness**2 / 6
    return torch.where(small, series, safe / -torch.expm1(-2 * safe))


def lobe_moments(sharpness: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the mean t̄, the variance v∥ along z, and the variance v⊥ in each direction across."""
    small = sharpness < 0.5
    safe = torch.where(small, torch.ones_like(sharpness), sharpness)
    x = torch.where(small, sharpness, torch.zeros_like(sharpness))
    coth = -(1 + torch.exp(-2 * safe)) / torch.expm1(-2 * safe)
    mean_over_x = 1 / 3 - x**2 / 45 + 2 * x**4 / 945 - x**6 / 4725
    across = torch.where(small, mean_over_x, (coth - 1 / safe) / safe)
    mean = torch.where(small, x * mean_over_x, coth - 1 / safe)
    along = (1 - 2 * across - mean**2).clamp_min(0)
    along = torch.where(sharpness > 20, 1 / safe**2, along)  # 1/λ² − 1/sinh²λ: the difference above loses its digits
    return mean, along, across
