"""Lambert + GGX, as Mitsuba's `diffuse` and `roughconductor` (material none, separable Smith) evaluate them.

    f = k_d/π + k_s D(h) G1(n·i) G1(n·o) / (4 (n·i)(n·o)),     no Fresnel (Wang et al. 2017)
    D = α² / (π ((n·h)² (α² − 1) + 1)²)                         Trowbridge and Reitz 1975, Walter et al. 2007
    G1(c) = 2c / (c + √(α² + (1 − α²) c²))                      Smith, as in Walter et al. 2007, eq. 34
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

LEAST_COSINE = 1e-4  # grazing views and lights are taken at this cosine


def ggx(alpha: Tensor, cosine: Tensor) -> Tensor:
    """GGX normal distribution D at n·h = `cosine`; 1/steradian."""
    return alpha**2 / (math.pi * (cosine**2 * (alpha**2 - 1) + 1) ** 2)


def smith(alpha: Tensor, cosine: Tensor) -> Tensor:
    """One-sided Smith shadowing G1; zero below the horizon."""
    c = cosine.clamp_min(0.0)
    return 2 * c / (c + torch.sqrt(alpha**2 + (1 - alpha**2) * c**2)).clamp_min(1e-30)


def specular_times_cosine(alpha: Tensor, normal_light: Tensor, normal_view: Tensor, normal_half: Tensor) -> Tensor:
    """The specular part for k_s = 1 times n·i: D G / (4 n·o)."""
    shadow = smith(alpha, normal_light) * smith(alpha, normal_view)
    return ggx(alpha, normal_half) * shadow / (4 * normal_view.clamp_min(LEAST_COSINE))


def lobe_integral(sharpness: Tensor) -> Tensor:
    """∫ exp(λ(ω·z − 1)) dω = 2π (1 − e^{−2λ}) / λ over the sphere; 4π at λ = 0, stable everywhere.

    >>> round(float(lobe_integral(torch.tensor(1e-9))) / math.pi, 5)
    4.0
    """
    small = sharpness < 1e-3
    safe = torch.where(small, torch.ones_like(sharpness), sharpness)
    series = 2 - 2 * sharpness + 4 / 3 * sharpness**2
    return 2 * math.pi * torch.where(small, series, -torch.expm1(-2 * safe) / safe)
