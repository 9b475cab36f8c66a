"""Lambert + GGX reflectance, as Mitsuba's `diffuse` and `roughconductor` (material none, separable Smith) evaluate it.

f = k_d/π + k_s D(h) G1(n·i) G1(n·o) / (4 (n·i)(n·o)),     no Fresnel (Wang et al. 2017)
D = α² / (π ((n·h)² (α² − 1) + 1)²)                         Trowbridge and Reitz 1975, Walter et al. 2007
G1(c) = 2c / (c + √(α² + (1 − α²) c²))                      Smith, as in Walter et al. 2007, eq. 34
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

LEAST_COSINE = 1e-4  # grazing views are clamped to this cosine
LEAST_ALPHA = 1e-3  # mirrors are clamped to this α = roughness²


def ggx(alpha: Tensor, cosine: Tensor) -> Tensor:
    """Return the GGX normal distribution D at n·h = `cosine`, in 1/steradian."""
    return alpha**2 / (math.pi * (cosine**2 * (alpha**2 - 1) + 1) ** 2)


def smith(alpha: Tensor, cosine: Tensor) -> Tensor:
    """Return the one-sided Smith shadowing G1 at n·i or n·o = `cosine`; it is zero below the horizon."""
    c = cosine.clamp_min(0.0)
    return 2 * c / (c + torch.sqrt(alpha**2 + (1 - alpha**2) * c**2))


def specular(alpha: Tensor, ni: Tensor, no: Tensor, nh: Tensor) -> Tensor:
    """Return the specular reflectance for k_s = 1, times n·i: D G / (4 n·o).

    Args:
        alpha: GGX width α = roughness².
        ni: Cosine n·i of the incident direction.
        no: Cosine n·o of the view direction.
        nh: Cosine n·h of the half vector.

    Returns:
        A tensor of the arguments' broadcast shape.
    """
    return ggx(alpha, nh) * smith(alpha, ni) * smith(alpha, no) / (4 * no.clamp_min(LEAST_COSINE))
