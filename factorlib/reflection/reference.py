"""The operator by quadrature in float64: slow, obvious, and what the others are tested against and trained on.

Diffuse   One integral: about z, the mean of max(n·i, 0) over azimuth has a closed form (`ring_mean`).  Polar angles are
          Gauss–Legendre nodes of the lobe's own distribution function, split where the ring meets the horizon.
Specular  Two double quadratures, each sampling one factor by its distribution function (Gauss–Legendre) and the azimuth
          uniformly (trapezoid, which is spectral for periodic functions): `about_lobe` draws i from the lobe and sums
          D G / (4 n·o); `about_normal` draws h from GGX and sums lobe · G (o·h) / (n·o n·h).  The sharper factor leads.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from factorlib.reflection.brdf import LEAST_COSINE, lobe_integral, smith, specular_times_cosine
from factorlib.reflection.operator import Operator

BATCH = 1 << 21  # integrand values held at once


class Reference(Operator):
    """Quadrature with `polar` × `azimuth` nodes; gradients by autograd through the nodes."""

    def __init__(self, dtype: torch.dtype = torch.float64, polar: int = 128, azimuth: int = 256):
        super().__init__(dtype)
        self.polar, self.azimuth = polar, azimuth

    def diffuse(self, sharpness: Float[Tensor, "*p"], nz: Float[Tensor, "n p"]) -> Float[Tensor, "n p"]:
        return diffuse_by_quadrature(sharpness.expand(nz.shape), nz)

    def specular(self, roughness: Tensor, sharpness: Tensor, no: Tensor, nz: Tensor, oz: Tensor) -> Float[Tensor, "n p"]:
        flat = [t.expand(nz.shape).reshape(-1) for t in (roughness, sharpness, no[:, None], nz, oz)]
        size = max(1, BATCH // (self.polar * self.azimuth))
        parts = [specular_by_quadrature(*(t[i : i + size] for t in flat), self.polar, self.azimuth) for i in range(0, nz.numel(), size)]
        return torch.cat(parts).reshape(nz.shape)


@lru_cache
def gauss_legendre(count: int) -> tuple[Tensor, Tensor]:
    """Nodes and weights on [0, 1]."""
    x, w = np.polynomial.legendre.leggauss(count)
    return torch.from_numpy((x + 1) / 2), torch.from_numpy(w / 2)


def lobe_quantile(sharpness: Tensor, u: Tensor) -> Tensor:
    """1 − i·z below which a share `u` of the lobe's integral lies; exact for small and large λ."""
    small = sharpness < 1e-6
    safe = torch.where(small, torch.ones_like(sharpness), sharpness)
    return torch.where(small, 2 * u, -torch.log1p(u * torch.expm1(-2 * safe)) / safe).clamp(0, 2)


def ring_mean(cosine: Tensor, t: Tensor) -> Tensor:
    """Mean of max(n·i, 0) over the ring i·z = t of an axis with n·z = `cosine`."""
    across = torch.sqrt(((1 - cosine**2) * (1 - t**2)).clamp_min(1e-300))
    level = cosine * t
    reach = torch.arccos((-level / across).clamp(-1, 1))  # half the arc above the horizon
    return ((level * reach + across * torch.sin(reach)) / math.pi).clamp_min(0)


def diffuse_by_quadrature(sharpness: Float[Tensor, "*n"], nz: Float[Tensor, "*n"], nodes: int = 96) -> Float[Tensor, "*n"]:
    """(1/π) ∫ lobe max(n·i, 0) di, split at the two polar angles where the ring touches the horizon."""
    lam, c = sharpness[..., None], nz.clamp(-1, 1)[..., None]
    touch = torch.sqrt((1 - c**2).clamp_min(0))  # |i·z| there
    norm = -torch.expm1(-2 * lam.clamp_min(1e-12))
    share = [(-torch.expm1(-lam.clamp_min(1e-12) * (1 - edge)) / norm).clamp(0, 1) for edge in (touch, -touch)]
    edges = [torch.zeros_like(c), *share, torch.ones_like(c)]
    x, w = gauss_legendre(nodes)
    total = torch.zeros_like(c[..., 0])
    for low, high in zip(edges, edges[1:], strict=False):
        t = 1 - lobe_quantile(lam, low + (high - low) * x)
        total = total + (ring_mean(c, t) * w).sum(-1) * (high - low)[..., 0]
    return lobe_integral(sharpness) / math.pi * total


def specular_by_quadrature(roughness: Tensor, sharpness: Tensor, no: Tensor, nz: Tensor, oz: Tensor, polar: int, azimuth: int) -> Tensor:
    """∫ lobe D G / (4 n·o) di for n cases at once, all inputs [n]."""
    alpha = roughness**2
    # the variance of i under the lobe is 2/λ; under GGX about the mirror direction some 4 α² per axis, tails beyond
    by_lobe = sharpness * alpha**2 > 0.5
    result = torch.zeros_like(nz)
    for chosen, integrate in ((by_lobe, about_lobe), (~by_lobe, about_normal)):
        if chosen.any():
            result = result.index_put((chosen.nonzero()[:, 0],), integrate(*(t[chosen] for t in (alpha, sharpness, no, nz, oz)), polar, azimuth))
    return result


def about_lobe(alpha: Tensor, sharpness: Tensor, no: Tensor, nz: Tensor, oz: Tensor, polar: int, azimuth: int) -> Float[Tensor, "n"]:
    """Draw i from the lobe."""
    alpha, no, lam = (t[:, None, None] for t in (alpha, no.clamp_min(LEAST_COSINE), sharpness))
    n, o = _frame_about(nz, oz, no[:, 0, 0])  # in a frame whose third axis is z
    x, w = gauss_legendre(polar)
    drop = lobe_quantile(lam, x[None, :, None])
    t, s = 1 - drop, torch.sqrt((drop * (2 - drop)).clamp_min(0))
    phi = (torch.arange(azimuth) + 0.5) / azimuth * 2 * math.pi
    i = (s * torch.cos(phi), s * torch.sin(phi), t.expand(-1, -1, azimuth))
    ni, oi = (sum(v[:, k, None, None] * i[k] for k in range(3)) for v in (n, o))
    nh = (ni + no) / torch.sqrt((2 + 2 * oi).clamp_min(1e-12))
    value = specular_times_cosine(alpha, ni, no, nh.clamp(0, 1))
    return lobe_integral(sharpness) * (value * w[None, :, None]).sum((1, 2)) / azimuth


def about_normal(alpha: Tensor, sharpness: Tensor, no: Tensor, nz: Tensor, oz: Tensor, polar: int, azimuth: int) -> Float[Tensor, "n"]:
    """Draw h from GGX: with tan² θ_h = α² u / (1 − u) the density of h is D n·h."""
    alpha, no, lam = (t[:, None, None] for t in (alpha, no.clamp_min(LEAST_COSINE), sharpness))
    o, z = _frame_about(no[:, 0, 0], nz, oz)  # in a frame whose third axis is n: o and z
    x, w = gauss_legendre(polar)
    u, weight = x**2 * (3 - 2 * x), w * 6 * x * (1 - x)  # smooth the ends, where tan θ grows without bound
    nh = torch.sqrt((1 - u) / (1 - u + alpha[:, 0] ** 2 * u))[:, :, None]
    sin = torch.sqrt((1 - nh**2).clamp_min(0))
    phi = (torch.arange(azimuth) + 0.5) / azimuth * 2 * math.pi
    h = (sin * torch.cos(phi), sin * torch.sin(phi), nh.expand(-1, -1, azimuth))
    oh, zh = (sum(v[:, k, None, None] * h[k] for k in range(3)) for v in (o, z))
    ni, zi = 2 * oh * h[2] - no, 2 * oh * zh - oz[:, None, None]
    shadow = smith(alpha, ni) * smith(alpha, no)
    value = torch.exp(lam * (zi - 1).clamp_max(0)) * shadow * oh.clamp_min(0) / (no * h[2].clamp_min(1e-9))
    return (value * weight[None, :, None]).sum((1, 2)) / azimuth


def _frame_about(first: Tensor, second: Tensor, between: Tensor) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    """Two unit vectors with third components `first`, `second` and the given cosine `between` them."""
    sin_first = torch.sqrt((1 - first**2).clamp_min(1e-14))
    x = (between - first * second) / sin_first
    y = torch.sqrt((1 - second**2 - x**2).clamp_min(0))
    zero = torch.zeros_like(first)
    return torch.stack([sin_first, zero, first], -1), torch.stack([x, y, second], -1)
