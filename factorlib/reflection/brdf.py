"""Lambert + GGX, as Mitsuba's `diffuse` and `roughconductor` (material none, separable Smith) evaluate them.

f = k_d/π + k_s D(h) G1(n·i) G1(n·o) / (4 (n·i)(n·o)),     no Fresnel (Wang et al. 2017)
D = α² / (π ((n·h)² (α² − 1) + 1)²)                         Trowbridge and Reitz 1975, Walter et al. 2007
G1(c) = 2c / (c + √(α² + (1 − α²) c²))                      Smith, as in Walter et al. 2007, eq. 34
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

LEAST_COSINE = 1e-4  # grazing views are taken at this cosine
LEAST_ALPHA = 1e-3  # mirrors are taken at this roughness²


def ggx(alpha: Tensor, cosine: Tensor) -> Tensor:
    """GGX normal distribution D at n·h = `cosine`, 1/steradian."""
    return alpha**2 / (math.pi * (cosine**2 * (alpha**2 - 1) + 1) ** 2)


def smith(alpha: Tensor, cosine: Tensor) -> Tensor:
    """One-sided Smith shadowing G1; zero below the horizon."""
    c = cosine.clamp_min(0.0)
    return 2 * c / (c + torch.sqrt(alpha**2 + (1 - alpha**2) * c**2))


def specular(alpha: Tensor, ni: Tensor, no: Tensor, nh: Tensor) -> Tensor:
    """The specular reflectance for k_s = 1 times n·i: D G / (4 n·o)."""
    return ggx(alpha, nh) * smith(alpha, ni) * smith(alpha, no) / (4 * no.clamp_min(LEAST_COSINE))
