"""Specular reflection of a lobe by one filtered normal distribution: a formula that is smooth in every input.

The frame has n = (0, 0, 1) and o in the plane y = 0. In the plane of projected half vectors p = (h_x, h_y) the GGX
distribution is a Student distribution without singularities, D = 1/(π α² (1 + k p²)²) with k = (1 − α²)/α²
(Tokuyoshi and Kaplanyan 2021). A Student distribution is a mixture of normal ones,
1/(1 + x)² = ∫ τ e^{−τ(1+x)} dτ ≈ Σ w e^{−τx} + 1/((1 + x)² + T²). Its last term is the far tail, which is flat on the
scale of any lobe that reaches it. Hence

    ∫ SG(i) D(h) di  ≈  E / (π α²) Σ w ∫ N(p; c, V) e^{−τ k p²} dp
                     =  E / (π α²) Σ w |I + 2τkV|^{−½} e^{−τk cᵀ(I + 2τkV)⁻¹c}                                     (1)

where N(p; c, V) is the lobe, written as a normal distribution of p. It is the lobe's expansion about a point p*. The
incident direction there is i* = 2(o·h*)h* − o, and J = ∂i/∂p:  |i − z|² ≈ |i* + J(p − p*) − z|². With
λ' = λ/(1 − e^{−2λ}), which keeps the lobe's integral,

    V = (λ' JᵀJ)⁻¹,     c = p* + (JᵀJ)⁻¹ Jᵀz,     and a factor e^{−λ(1 − i*·z)²/2}                                 (2)

for the part of z − i* along i*.

If light is narrower than D, their product is large about the half vector of o and z; if D is narrower, about p = 0. If
both are narrow and far apart, the product has two modes, and the mode of larger integral is taken. So p* is a blend of
the two places, improved by one Gauss–Newton step to the product's mode. A logistic law turns the mean and deviation of
n·i there into the part of the light above the horizon.
"""

from __future__ import annotations

from collections import namedtuple

import msgspec
import torch
from torch import Tensor
from torch.nn.functional import softplus

from factorlib.reflection.brdf import LEAST_ALPHA, LEAST_COSINE, smith
from factorlib.reflection.lobe import gaussian_sharpness, lobe_moments

# (τ, w) of 1/(1 + x)² ≈ Σ w e^{−τx}: studies/measured/operator_fit.py of version 0.1.0 fitted these
GAUSSIANS = (
    (0.00526739272, 6.63308013e-06),
    (0.0161784582, 0.000251757547),
    (0.044304079, 0.00200260083),
    (0.129553576, 0.015833542),
    (0.378542089, 0.104991034),
    (1.09856493, 0.426327784),
    (3.15835381, 0.450414161),
)
TAIL = 200.0  # T of (1): the mixture's far tail is 1/((1 + x)² + T²)
LOGISTIC = 1.702  # the logistic law of this scale is within 0.01 of the normal one
LEAST_HALF = 2e-4  # least |o + z|²
LEAST_HN, LARGEST_P = 1e-3, 0.998
SHARE = 2.0  # curvature of −log D at its peak over k, as assumed by the blend
WIDE = 0.03  # V of a lobe is at most 1/WIDE, because p ends at the unit circle
RIDGE = 1e-4  # keeps JᵀJ regular where h is perpendicular to o
# PEAK k / (1 + kp²): curvature of −log D as assumed by the step to the mode, between 4k at the peak and 2k on the whole
PEAK = 3.0
# components so, no, zx, zy, nz of o = (so, 0, no) and z = (zx, zy, nz) in the frame with n = (0, 0, 1)
Directions = tuple[Tensor, Tensor, Tensor, Tensor, Tensor]


class Filtered(msgspec.Struct):
    """Value and intermediate results of the specular formula; every field has the shape of the inputs."""

    value: Tensor
    ratio: Tensor  # 1 − e^{−2λ}
    sharpness: Tensor  # λ'
    px: Tensor  # p* about which the lobe was expanded
    py: Tensor
    misfit: Tensor  # λ (1 − i*·z)² / 2
    density: Tensor  # D of (1), D(0) = 1
    spread: Tensor  # log |I + 2kV|
    distance: Tensor  # k c²
    ni: Tensor  # mean n·i of the product
    deviation: Tensor  # standard deviation of n·i
    lit: Tensor  # part of the light above the horizon
    cosine: Tensor  # mean n·i of that part


# the lobe about p*: JᵀJ and its determinant, c of (2), i*·z, n·i*, and the derivatives of n·i by p
Expansion = namedtuple("Expansion", ("xx", "yy", "xy", "det", "cx", "cy", "along", "ni", "nix", "niy"))


def filtered_specular(alpha: Tensor, sharpness: Tensor, no: Tensor, nz: Tensor, oz: Tensor) -> Filtered:
    """Return ∫ exp(λ(i·z − 1)) D G / (4 n·o) di over n·i > 0, with its intermediate results.

    Args:
        alpha: GGX width α = roughness².
        sharpness: Sharpness λ of the lobe.
        no: Cosine n·o of the view direction.
        nz: Cosine n·z of the lobe's axis.
        oz: Cosine o·z between view and axis.

    Returns:
        Tensors of the arguments' common shape.
    """
    return filtered(alpha, sharpness, gaussian_sharpness(sharpness), lobe_moments(sharpness)[1], no, nz, oz)


def filtered(
    alpha: Tensor, sharpness: Tensor, lam: Tensor, variance: Tensor, no: Tensor, nz: Tensor, oz: Tensor
) -> Filtered:
    """Return `filtered_specular` of a lobe whose λ' of (2) and moments are known.

    Args:
        alpha: GGX width α = roughness².
        sharpness: Sharpness λ of the lobe.
        lam: λ' of (2).
        variance: Variance of i·z along the lobe's axis.
        no: Cosine n·o of the view direction.
        nz: Cosine n·z of the lobe's axis.
        oz: Cosine o·z between view and axis.

    Returns:
        Tensors of the arguments' common shape.
    """
    alpha, no = alpha.clamp(LEAST_ALPHA, 1), no.clamp(LEAST_COSINE, 1)
    # components of o and z, and k of D
    so = torch.sqrt((1 - no * no).clamp_min(1e-8))
    zx = (oz - no * nz) / so
    zy = torch.sqrt((1 - nz * nz - zx * zx).clamp_min(1e-8))
    k = (1 - alpha * alpha) / (alpha * alpha)
    directions = so, no, zx, zy, nz
    # p* and the lobe's expansion about it, (2)
    px, py = _blend(k, lam, oz, directions)
    px, py = _mode(k, lam, px, py, directions)
    at = _expansion(lam, px, py, directions)
    misfit = 0.5 * sharpness * (1 - at.along) ** 2
    density, spread = _student(k, lam, at, sharpness / lam, misfit)  # (1)
    # mean and deviation of n·i over the product of light and D
    r = PEAK * k / (1 + k * (px * px + py * py)) / lam
    mx, my, total = _product(r, at)
    ni = at.ni + at.nix * (mx - px) + at.niy * (my - py)
    spread_of_ni = (at.nix * at.nix * (at.yy + r) + at.niy * at.niy * (at.xx + r) - 2 * at.nix * at.niy * at.xy) / total
    deviation = torch.sqrt(spread_of_ni / lam + variance * ni * ni + 1e-8)
    # part of the light above the horizon and its mean n·i, by the logistic law
    u = LOGISTIC * (ni / deviation).clamp_min(-20)
    lit = torch.sigmoid(u)
    cosine = deviation * softplus(u) / (LOGISTIC * lit)
    # E D G / (4 n·o) with E = 2π/λ' and D = density / (π α²)
    shadowed = lit * smith(alpha, cosine) * smith(alpha, no) / (4 * no)
    value = 2 / (lam * alpha * alpha) * density * shadowed
    distance = k * (at.cx * at.cx + at.cy * at.cy)
    return Filtered(value, sharpness / lam, lam, px, py, misfit, density, spread, distance, ni, deviation, lit, cosine)


def _blend(k: Tensor, lam: Tensor, oz: Tensor, directions: Directions) -> tuple[Tensor, Tensor]:
    """Return the starting point p between n and the half vector of o and z.

    The blend depends on the widths and weights of light and D there, both taken as isotropic.
    """
    so, no, zx, zy, nz = directions
    # half vector of o and z, and the lobe's variance in p there
    x, y, z = so + zx, zy, no + nz
    length = torch.sqrt(x * x + y * y + z * z + 1e-6)
    x, y, z = x / length, y / length, z / length
    variance = 1 / (lam * (2 + 2 * oz).clamp_min(LEAST_HALF))
    # choose between the modes at the half vector and at n by their integrals, then blend by curvature
    square = x * x + y * y
    tail = 1 + k * square
    broad = 1 + SHARE * k * variance
    chosen = torch.sigmoid((0.5 * square / variance).clamp_max(40) - 2 * torch.log(tail) + torch.log(broad))
    share = chosen * tail / (tail + SHARE * k * variance) + (1 - chosen) / broad
    x, y, z = share * x, share * y, share * z + 1 - share
    scale = torch.rsqrt(x * x + y * y + z * z + 1e-12)
    return x * scale, y * scale


def _mode(k: Tensor, lam: Tensor, px: Tensor, py: Tensor, directions: Directions) -> tuple[Tensor, Tensor]:
    """Take one Gauss–Newton step from p to the mode of light times D: (JᵀJ + r)⁻¹ JᵀJ c, kept inside the disc."""
    at = _expansion(lam, px, py, directions)
    x, y, _ = _product(PEAK * k / (1 + k * (px * px + py * py)) / lam, at)
    outside = torch.sqrt((x * x + y * y) / LARGEST_P + 1e-12).clamp_min(1.0)
    return x / outside, y / outside


def _product(r: Tensor, at: Expansion) -> tuple[Tensor, Tensor, Tensor]:
    """Return (JᵀJ + r I)⁻¹ JᵀJ c, the mode of light about c times D about 0, and the determinant |JᵀJ + r I|."""
    total = at.det + r * (at.xx + at.yy) + r * r
    shrink = r / total
    x = at.cx - shrink * ((at.yy + r) * at.cx - at.xy * at.cy)
    return x, at.cy - shrink * ((at.xx + r) * at.cy - at.xy * at.cx), total


def _expansion(lam: Tensor, px: Tensor, py: Tensor, directions: Directions) -> Expansion:
    """Expand the lobe of width `lam` = λ' about p, as in (2)."""
    so, no, zx, zy, nz = directions
    hn = torch.sqrt((1 - px * px - py * py).clamp_min(LEAST_HN))
    oh = so * px + no * hn
    tx, ty = px / hn, py / hn
    ax, ay = so - no * tx, -no * ty  # ∂(o·h)/∂p
    # ∂i/∂p = 2 ∂(o·h)/∂p h + 2 (o·h) ∂h/∂p, halved
    xx1, xx2, xx3 = ax * px + oh, ax * py, ax * hn - oh * tx
    yy1, yy2, yy3 = ay * px, ay * py + oh, ay * hn - oh * ty
    # JᵀJ with its ridge, and Jᵀz
    ridge = RIDGE + WIDE / lam
    xx = 4 * (xx1 * xx1 + xx2 * xx2 + xx3 * xx3) + ridge
    yy = 4 * (yy1 * yy1 + yy2 * yy2 + yy3 * yy3) + ridge
    xy = 4 * (xx1 * yy1 + xx2 * yy2 + xx3 * yy3)
    bx = 2 * (xx1 * zx + xx2 * zy + xx3 * nz)
    by = 2 * (yy1 * zx + yy2 * zy + yy3 * nz)
    det = (xx * yy - xy * xy).clamp_min(1e-7)
    # i*·z with i* = 2(o·h)h − o, and c = p* + (JᵀJ)⁻¹ Jᵀz, (2)
    along = 2 * oh * (px * zx + py * zy + hn * nz) - (so * zx + no * nz)
    cx, cy = px + (yy * bx - xy * by) / det, py + (xx * by - xy * bx) / det
    return Expansion(xx, yy, xy, det, cx, cy, along, 2 * oh * hn - no, 2 * xx3, 2 * yy3)


def _student(k: Tensor, lam: Tensor, at: Expansion, ratio: Tensor, misfit: Tensor) -> tuple[Tensor, Tensor]:
    """Return the sum of (1) with the factor of (2), and log |I + 2kV|.

    V is (λ' JᵀJ)⁻¹; the exponents are those of the true λ = ratio λ'.
    """
    cx, cy = at.cx, at.cy
    # trace and determinant of V, and |c|²
    volume = lam * at.det
    trace = (at.xx + at.yy) / volume
    determinant = 1 / (volume * lam)
    square = cx * cx + cy * cy
    across = (at.yy * cx * cx + at.xx * cy * cy - 2 * at.xy * cx * cy) / volume  # cᵀVc
    # the mixture of (1), for each τ: |I + 2τkV| and the exponent τk cᵀ(I + 2τkV)⁻¹c
    density: Tensor | int = 0
    for rate, weight in GAUSSIANS:
        f = 2 * rate * k
        inflation = 1 + f * (trace + f * determinant)
        exponent = 0.5 * f * (square + f * (trace * square - across)) / inflation
        density = density + weight * torch.exp(-(ratio * exponent + misfit).clamp_max(60)) * torch.rsqrt(inflation)
    x = 1 + k * (square + trace)
    tail = torch.exp(-misfit.clamp_max(60)) / (x * x + TAIL * TAIL)
    return density + tail, torch.log1p(2 * k * (trace + 2 * k * determinant))
