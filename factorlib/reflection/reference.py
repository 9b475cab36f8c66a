"""Reference operator: the reflection of one lobe by quadrature in float64.

It is slow and straightforward; the other operators are compared with it.

The specular part ∫_{n·i>0} SG(i) D(h) G1(n·i) di · G1(n·o) / (4 n·o) has two sharp factors, each symmetric about its
own axis. There is one quadrature in polar coordinates about each axis:

    about z   i at (θ, φ) from the lobe's axis: SG is a function of θ alone;             di = sin θ dθ dφ
    about n   h at (θ, φ) from the normal: D is a function of θ alone, i = 2(o·h)h − o;  di = 4(o·h) sin θ dθ dφ

The quadrature about the sharper factor is taken, since the other factor is broad there. Both cross the horizon n·i = 0
alike: below the angle a whole circles are lit, above b none, and between them the arc |φ| < φ_max(θ). Each piece is
smooth, so that Gauss–Legendre and trapezoidal rules converge geometrically; θ = a + (b − a) sin²(ψ/2) makes
φ_max ~ √(θ − a) smooth. The number of nodes is raised, element by element, until two rules agree.

The diffuse part is one integral over i·z, because its azimuthal integral is elementary.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from factorlib.reflection.brdf import LEAST_COSINE, ggx, smith
from factorlib.reflection.lobe import lobe_integral
from factorlib.reflection.operator import Operator, columns

LEVELS = (8, 12, 18, 27, 40, 60, 90, 135, 202, 303, 455)  # nodes in each direction, raised until two levels agree
FLOOR = 1e-5  # errors are relative to S + FLOOR × the lobe's integral
REACH = 7.6  # a lobe is cut at e^(−REACH²/2) of its peak
NODES_AT_ONCE = 1 << 17


class Reference(Operator):
    """Reflection operator by quadrature.

    Args:
        dtype: Floating-point type.
        tolerance: Relative difference of two levels of nodes at which the finer one is taken.
    """

    def __init__(self, dtype: torch.dtype = torch.float64, tolerance: float = 1e-7):
        super().__init__(dtype)
        self.tolerance = tolerance

    def diffuse(self, sharpness: Float[Tensor, "*p"], nz: Float[Tensor, "n p"]) -> Float[Tensor, "n p"]:
        """Return the diffuse reflection of unit lobes by quadrature; see `Operator.diffuse`."""
        return diffuse_quadrature(sharpness.expand(nz.shape), nz)

    def specular(self, roughness: Tensor, sharpness: Tensor, no: Tensor, nz: Tensor, oz: Tensor) -> Tensor:
        """Return the specular reflection of unit lobes by quadrature, converged to the tolerance.

        Args:
            roughness: Roughness √α, [] or [n, p].
            sharpness: Sharpness λ, [p] or [n, p].
            no: Cosine n·o, [n] or [n, p].
            nz: Cosine n·z, [n, p].
            oz: Cosine o·z, [n, p].

        Returns:
            Reflection for k_s = 1, [n, p].
        """
        scalars = torch.broadcast_tensors(roughness**2, sharpness, columns(no), nz, oz)
        return converged(*(t.reshape(-1) for t in scalars), tolerance=self.tolerance).reshape(nz.shape)


def converged(alpha: Tensor, sharpness: Tensor, no: Tensor, nz: Tensor, oz: Tensor, *, tolerance: float) -> Tensor:
    """Return the specular part of every element at the first level of nodes that agrees with the level before it.

    Args:
        alpha: GGX width α = roughness², [b].
        sharpness: Sharpness λ of the lobe, [b].
        no: Cosine n·o of the view direction, [b].
        nz: Cosine n·z of the lobe's axis, [b].
        oz: Cosine o·z between view and axis, [b].
        tolerance: Relative difference of two levels that agree.

    Returns:
        A tensor [b], differentiable in every input.
    """
    scalars = alpha, sharpness, no, nz, oz
    value, level = torch.zeros_like(alpha), torch.zeros(alpha.shape, dtype=torch.long)
    with torch.no_grad():
        floor = FLOOR * lobe_integral(sharpness)
        todo = torch.arange(len(alpha))
        # raise the number of nodes of the elements that have not converged; the coarsest two levels may agree by chance
        first = 1 if tolerance < 1e-4 else 0
        for k, nodes in enumerate(LEVELS[first:], first):
            if not len(todo):
                break
            previous = value[todo]
            value[todo] = finer = specular_quadrature(nodes, *(t[todo] for t in scalars))
            level[todo] = k
            agrees = (finer - previous).abs() <= tolerance * (finer + floor[todo])
            todo = todo[~agrees] if k > first else todo
    if not any(t.requires_grad for t in scalars):
        return value
    # evaluate each element once more at its level, now on torch's graph
    for k, nodes in enumerate(LEVELS):
        where = torch.nonzero(level == k)[:, 0]
        if len(where):
            value = value.index_put((where,), specular_quadrature(nodes, *(t[where] for t in scalars)))
    return value


def specular_quadrature(nodes: int, *scalars: Tensor) -> Float[Tensor, " b"]:
    """Return ∫ SG D G / (4 n·o) di, by quadrature about the sharper factor.

    Args:
        nodes: Number of nodes in each direction of each piece.
        *scalars: α, λ, n·o, n·z, o·z, [b] each, processed in chunks that bound the memory.

    Returns:
        A tensor [b].
    """
    values = []
    rows = max(1, NODES_AT_ONCE // (2 * nodes * nodes))
    for alpha, sharpness, no, nz, oz in zip(*(t.split(rows) for t in scalars), strict=True):
        no, nz, oz = no.clamp(LEAST_COSINE, 1), nz.clamp(-1, 1), oz.clamp(-1, 1)
        # about n where D is narrower than the lobe and the lobe reaches D's peak: its axis is near the mirror direction
        deviation = 1 / torch.sqrt(sharpness)
        about_normal = 2 * alpha * torch.sqrt(no) < deviation
        about_normal &= mirror_angle(no, nz, oz) < reach_of(sharpness) + 0.5 * deviation
        value = torch.zeros_like(alpha)
        for rule, chosen in ((about_half_vector, about_normal), (about_lobe, ~about_normal)):
            where = torch.nonzero(chosen)[:, 0]
            if len(where):
                value = value.index_put((where,), rule(nodes, *(t[where] for t in (alpha, sharpness, no, nz, oz))))
        values.append(value * smith(alpha, no) / (4 * no))
    return torch.cat(values)


def reach_of(sharpness: Tensor) -> Tensor:
    """Return the angle from its axis at which a lobe is truncated, in radians."""
    half = REACH / 2 / torch.sqrt(sharpness)
    return torch.where(half < 0.999, 2 * torch.arcsin(half.clamp(max=0.999)), torch.full_like(half, math.pi))


def mirror_angle(no: Tensor, nz: Tensor, oz: Tensor) -> Tensor:
    """Return the angle between the lobe's axis and the mirror direction 2(n·o)n − o, in radians.

    Args:
        no: Cosine n·o of the view direction.
        nz: Cosine n·z of the lobe's axis.
        oz: Cosine o·z between view and axis.

    Returns:
        A tensor of the arguments' broadcast shape.
    """
    return torch.arccos((2 * no * nz - oz).clamp(-1, 1))


def about_lobe(nodes: int, alpha: Tensor, sharpness: Tensor, no: Tensor, nz: Tensor, oz: Tensor) -> Float[Tensor, " b"]:
    """Return ∫ SG(i) D(h) G1(n·i) di in polar coordinates about z, with the azimuth from the plane of z and n.

    Args:
        nodes: Number of nodes in each direction of each piece.
        alpha: GGX width α = roughness², [b].
        sharpness: Sharpness λ of the lobe, [b].
        no: Cosine n·o of the view direction, [b].
        nz: Cosine n·z of the lobe's axis, [b].
        oz: Cosine o·z between view and axis, [b].

    Returns:
        A tensor [b].
    """
    alpha, sharpness, no, nz, oz = (t[:, None, None] for t in (alpha, sharpness, no, nz, oz))
    sz = root(1 - nz**2)
    ox = (no - nz * oz) / sz  # o along the direction from z to n
    oy = root(1 - oz**2 - ox**2)
    # limits a and b of the polar angle between whole circles, arcs and nothing lit, cut at the lobe's reach
    tilt = torch.atan2(sz, nz)
    a, b = (math.pi / 2 - tilt).abs(), math.pi - (math.pi / 2 - tilt).abs()
    reach = reach_of(sharpness)
    above, zero = nz > 0, torch.zeros_like(a)
    full = torch.where(above, zero, b.minimum(reach)), torch.where(above, a, zero + math.pi).minimum(reach)

    def integrand(theta: Tensor, cos_phi: Tensor, sin_phi: Tensor) -> Tensor:
        """Return SG(i) D(h) G1(n·i) sin θ at polar angle θ and azimuth φ."""
        cos, sin = torch.cos(theta), torch.sin(theta)
        ni, oi = nz * cos + sz * sin * cos_phi, oz * cos + sin * (ox * cos_phi + oy * sin_phi)
        nh = (no + ni) / torch.sqrt((2 + 2 * oi).clamp_min(1e-12))
        lobe = torch.exp(-2 * sharpness * torch.sin(theta / 2) ** 2)
        return lobe * sin * ggx(alpha, nh.clamp(max=1)) * smith(alpha, ni)

    circles = over_circles(
        nodes, *full, integrand
    )  # before the arcs' limits: this fixes the order of derivatives' sums
    limits = a.minimum(reach), b.minimum(reach)
    return circles + over_arcs(
        nodes, *limits, integrand, lambda theta: -nz * torch.cos(theta) / (sz * torch.sin(theta))
    )


def about_half_vector(nodes: int, alpha: Tensor, sharpness: Tensor, no: Tensor, nz: Tensor, oz: Tensor) -> Tensor:
    """Return ∫ SG(i) D(h) G1(n·i) 4(o·h) dh in polar coordinates about n, with the azimuth from the plane of n and o.

    θ = α sinh y spreads the nodes over the peak of D and over its tail alike.

    Args:
        nodes: Number of nodes in each direction of each piece.
        alpha: GGX width α = roughness², [b].
        sharpness: Sharpness λ of the lobe, [b].
        no: Cosine n·o of the view direction, [b].
        nz: Cosine n·z of the lobe's axis, [b].
        oz: Cosine o·z between view and axis, [b].

    Returns:
        A tensor [b].
    """
    alpha, sharpness, no, nz, oz = (t[:, None, None] for t in (alpha, sharpness, no, nz, oz))
    so = root(1 - no**2)
    zx = (oz - no * nz) / so  # z along the direction from n to o
    zy = root(1 - nz**2 - zx**2)
    # limits in y = asinh(θ/α): the least θ that the lobe reaches, and the horizon at θ = (π/2 ∓ tilt)/2
    tilt = torch.atan2(so, no)
    least = (mirror_angle(no, nz, oz) - reach_of(sharpness)).clamp_min(0) / 2
    y_least, y_a, y_b = (torch.asinh(t / alpha) for t in (least, (math.pi / 2 - tilt) / 2, (math.pi / 2 + tilt) / 2))

    def integrand(y: Tensor, cos_phi: Tensor, sin_phi: Tensor) -> Tensor:
        """Return SG(i) D(h) G1(n·i) 4(o·h) sin θ dθ/dy at θ = α sinh y and azimuth φ."""
        theta = alpha * torch.sinh(y)
        cos, sin = torch.cos(theta), torch.sin(theta)
        oh, zh = no * cos + so * sin * cos_phi, nz * cos + sin * (zx * cos_phi + zy * sin_phi)
        lobe = torch.exp(-sharpness * (1 + oz - 2 * oh * zh))
        return lobe * ggx(alpha, cos) * smith(alpha, 2 * oh * cos - no) * 4 * oh * sin * alpha * torch.cosh(y)

    circles = over_circles(nodes, y_least.minimum(y_a), y_a, integrand)  # before the arcs' limits, as in `about_lobe`
    limits = y_least.clamp(y_a, y_b), y_b
    return circles + over_arcs(nodes, *limits, integrand, lambda y: -no / (so * torch.tan(2 * alpha * torch.sinh(y))))


def over_circles(nodes: int, low: Tensor, high: Tensor, integrand: Callable[..., Tensor]) -> Float[Tensor, " b"]:
    """Integrate over whole circles at radii [low, high].

    Args:
        nodes: Number of radial nodes; each circle has twice as many.
        low: Lower limit of the radius, [b, 1, 1].
        high: Upper limit of the radius, [b, 1, 1].
        integrand: Function of radius, cos φ and sin φ.

    Returns:
        A tensor [b].
    """
    # Gauss–Legendre in the radius, midpoint rule in the azimuth
    x, w = gauss(nodes, low.dtype)
    phi = 2 * math.pi * (torch.arange(2 * nodes, dtype=low.dtype) + 0.5) / (2 * nodes)
    radius = low + (high - low) * x[None, :, None]
    inner = integrand(radius, torch.cos(phi), torch.sin(phi)).sum(2) * (math.pi / nodes)
    return (inner * w * (high - low)[:, :, 0]).sum(1)


def over_arcs(nodes: int, low: Tensor, high: Tensor, integrand: Callable[..., Tensor], cos_arc: Callable) -> Tensor:
    """Integrate over the arcs |φ| < arccos(cos_arc) at radii [low, high].

    Light beyond an arc comes from below the surface. The length of the arcs goes like a root at both ends.

    Args:
        nodes: Number of radial nodes; each arc has twice as many.
        low: Lower limit of the radius, [b, 1, 1].
        high: Upper limit of the radius, [b, 1, 1].
        integrand: Function of radius, cos φ and sin φ.
        cos_arc: Function of the radius that returns the cosine of the arc's half angle.

    Returns:
        A tensor [b].
    """
    # radius = low + (high − low) sin²(πx/2) with its derivative, then Gauss–Legendre along each arc
    x, w = gauss(nodes, low.dtype)
    radius = low + (high - low) * (torch.sin(math.pi / 2 * x) ** 2)[None, :, None]
    stretch = (high - low)[:, :, 0] * math.pi / 2 * torch.sin(math.pi * x)
    arc = torch.arccos(cos_arc(radius).clamp(-1 + 1e-12, 1 - 1e-12))
    t, v = gauss(2 * nodes, low.dtype)
    phi = arc * (2 * t - 1)
    inner = (integrand(radius, torch.cos(phi), torch.sin(phi)) * v).sum(2) * 2 * arc[:, :, 0]
    return (inner * w * stretch).sum(1)


def diffuse_quadrature(sharpness: Tensor, nz: Tensor, nodes: int = 48) -> Tensor:
    """Return the diffuse part (1/π) ∫ exp(−λ(1 − cos θ)) sin θ g(θ) dθ.

    The azimuthal integral is g = ∫ max(n·i, 0) dφ = 2 (c φ_max cos θ + s sin θ sin φ_max).

    Args:
        sharpness: Sharpness λ of the lobe, [*b].
        nz: Cosine c = n·z of the lobe's axis, [*b].
        nodes: Number of nodes of each of three pieces.

    Returns:
        A tensor [*b].
    """
    lam, c = sharpness[..., None], nz.clamp(-1, 1)[..., None]
    s = root(1 - c**2)
    a = (math.pi / 2 - torch.atan2(s, c)).abs()
    reach = reach_of(lam)
    low = torch.zeros_like(a)
    x, w = gauss(nodes, c.dtype)
    total = torch.zeros((), dtype=c.dtype)
    # pieces of θ: whole circles (or none), arcs between a and π − a, none (or whole circles)
    for first, last in ((low, a), (a, math.pi - a), (math.pi - a, low + math.pi)):
        first, last = first.minimum(reach), last.minimum(reach)
        theta = first + (last - first) * torch.sin(math.pi / 2 * x) ** 2
        weight = w * (last - first) * math.pi / 2 * torch.sin(math.pi * x)
        cos, sin = torch.cos(theta), torch.sin(theta)
        arc = torch.arccos((-c * cos / (s * sin).clamp_min(1e-30)).clamp(-1 + 1e-14, 1 - 1e-14))
        lit = 2 * (c * cos * arc + s * sin * torch.sin(arc))
        total = total + (weight * torch.exp(-2 * lam * torch.sin(theta / 2) ** 2) * sin * lit).sum(-1)
    return total.clamp_min(0) / math.pi


def root(square: Tensor) -> Tensor:
    """Return √(max(x, 1e-14)), a root of finite derivative; negative x are rounding errors."""
    return torch.sqrt(square.clamp_min(1e-14))


@lru_cache(maxsize=64)
def gauss(nodes: int, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """Return Gauss–Legendre nodes and weights on [0, 1]."""
    x, w = np.polynomial.legendre.leggauss(nodes)
    return torch.tensor((x + 1) / 2, dtype=dtype), torch.tensor(w / 2, dtype=dtype)
