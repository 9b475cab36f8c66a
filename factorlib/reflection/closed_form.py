"""Formulas for the reflection of a spherical Gaussian: cheap, smooth in every input, and right in their limits.

Diffuse   n·i over the lobe has mean m = t̄ c and variance τ² = v⊥ s² + v∥ c² (c = n·z, s² = 1 − c², t̄ = coth λ − 1/λ the
          mean of i·z, v∥ its variance, v⊥ = (1 − E[t²])/2).  Were it normal, E[max(n·i, 0)] = m Φ(m/τ) + τ φ(m/τ): exact
          as λ → ∞, 8 % low for the constant light, whose remainder a small Chebyshev series in (t̄, c) removes.

Specular  NDF filtering (after Tokuyoshi et al. 2024): the lobe has variance v⊥ about z, which is v⊥/4 along
          and v⊥/(4 (o·h)²) across the plane of o and z, of the half vector.  GGX has scale α² where a normal distribution
          has twice its variance, so the filtered one is GGX of the 2 × 2 matrix A = α² 1 + 2 Σ:
          D_A = 1 / (π √det A (h_n² + h_tᵀ A⁻¹ h_t)²), and the lobe's integral times D_A G / (4 n·o) approximates the
          reflection.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from factorlib.reflection.brdf import LEAST_COSINE, lobe_integral, smith
from factorlib.reflection.operator import Operator


def lobe_moments(sharpness: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Mean of i·z over a lobe, its variance, and the variance across: t̄, v∥, v⊥; stable for every λ ≥ 0."""
    small = sharpness < 0.2
    safe = torch.where(small, torch.ones_like(sharpness), sharpness)
    x = torch.where(small, sharpness, torch.zeros_like(sharpness))
    coth = -(1 + torch.exp(-2 * safe)) / torch.expm1(-2 * safe)
    mean = torch.where(small, x / 3 - x**3 / 45 + 2 * x**5 / 945, coth - 1 / safe)
    across = torch.where(small, 1 / 3 - x**2 / 45 + 2 * x**4 / 945, (coth - 1 / safe) / safe)  # (1 − E t²)/2 = t̄/λ
    along = (1 - 2 * across - mean**2).clamp_min(0)
    along = torch.where(sharpness > 50, 1 / safe**2, along)  # beyond, the difference above loses its digits
    return mean, along, across


class ClosedForm(Operator):
    """Formulas alone."""

    def diffuse(self, sharpness: Float[Tensor, "*p"], nz: Float[Tensor, "n p"]) -> Float[Tensor, "n p"]:
        return lobe_integral(sharpness) / math.pi * mean_cosine(sharpness, nz)

    def specular(self, roughness: Tensor, sharpness: Tensor, no: Tensor, nz: Tensor, oz: Tensor) -> Float[Tensor, "n p"]:
        return filtered_specular(roughness**2, sharpness, no[:, None], nz, oz)


def mean_cosine(sharpness: Tensor, nz: Tensor) -> Tensor:
    """E[max(n·i, 0)] over a lobe whose axis has n·z = `nz`, as if n·i were normally distributed."""
    mean, along, across = lobe_moments(sharpness)
    c = nz.clamp(-1, 1)
    m = mean * c
    deviation = torch.sqrt(across * (1 - c**2) + along * c**2 + 1e-12)
    u = m / deviation
    density = torch.exp(-0.5 * u**2) / math.sqrt(2 * math.pi)
    return (0.5 * m * torch.special.erfc(-u / math.sqrt(2)) + deviation * density).clamp_min(0)


def filtered_specular(alpha: Tensor, sharpness: Tensor, no: Tensor, nz: Tensor, oz: Tensor) -> Tensor:
    """The lobe's integral times D_A G / (4 n·o), see the module."""
    no = no.clamp(LEAST_COSINE, 1.0)
    _, _, across = lobe_moments(sharpness)
    # o + z has length √(2 + 2 o·z): half vector's cosines with n and with o
    length = torch.sqrt((2 + 2 * oz).clamp_min(1e-6))
    nh, oh = (no + nz) / length, (length / 2).clamp_min(1e-3)
    # e, in the plane of o and z and across h, is along z − o; d points from h to n in the tangent plane at h
    ne = (nz - no) / torch.sqrt((2 - 2 * oz).clamp_min(1e-6))
    off2 = (1 - nh**2).clamp_min(0.0)  # |n − (n·h) h|²
    cos2 = torch.where(off2 > 1e-6, (ne**2 / off2.clamp_min(1e-6)).clamp(0, 1), torch.full_like(nh, 0.5))
    along, perp = across / 4, across / (4 * (oh**2 + across))  # the last term keeps it finite for z = −o
    a_dd = alpha**2 + 2 * (along * cos2 + perp * (1 - cos2))
    a_xx = alpha**2 + 2 * (along * (1 - cos2) + perp * cos2)
    determinant = (a_dd * a_xx - 4 * (along - perp) ** 2 * cos2 * (1 - cos2)).clamp_min(1e-12)
    density = 1 / (math.pi * torch.sqrt(determinant) * (nh.clamp_min(0) ** 2 + off2 * a_xx / determinant) ** 2)
    # light below the horizon reflects in part: the shadowing term sees the mean of the clamped cosine
    lit = mean_cosine(sharpness, nz).clamp(1e-6, 1)
    return lobe_integral(sharpness) * density * smith(alpha, lit) * smith(alpha, no) / (4 * no)
