"""How much of a lobe a surface point sees, when it sees some directions and not others.

A point reflects ∫ L(i) f(i) V(i) di, f being the reflectance times the cosine and V ∈ [0, 1] what of direction i is not
hidden.  The reflection operator knows the integral without V.  What V leaves of it is taken from K fixed directions d_k:

    v = Σ_k V_k f_k L_k / Σ_k f_k L_k,       f_k = max(n·d_k, 0)             for the diffuse part                  (1)
                                             f_k = D(h_k) G1(n·d_k), GGX     for the specular part                (2)

with L_k the lobe at d_k.  V = 1 gives 1 exactly, a constant light the ambient occlusion.  V is known at the d_k alone,
so nothing may be narrower than their spacing: a lobe's sharpness λ becomes κ = 1/(1/λ + 1/κ_K), α² grows likewise.
Two sums over k for all points and lobes are two matrix products.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

FAINTEST = -40.0  # exponent of a lobe far from its axis: products stay normal numbers, which are multiplied much faster
# Of the lobe's light that the reflectance passes; below, the lobe is behind the surface and counts as seen.
LEAST = 1e-6


def widest_sharpness(count: int) -> float:
    """κ_K, the sharpness of lobes as wide as `count` directions lie apart: a Gaussian of half their spacing."""
    return count / math.pi


def cosine_weights(normals: Float[Tensor, "n 3"], directions: Float[Tensor, "k 3"]) -> Float[Tensor, "n k"]:
    """f of equation (1), each row's sum 1."""
    cosine = (normals @ directions.T).clamp_min(0)
    return cosine / cosine.sum(1, keepdim=True).clamp_min(1e-12)


def highlight_weights(
    normals: Float[Tensor, "n 3"], views: Float[Tensor, "n 3"], directions: Float[Tensor, "k 3"], roughness: float
) -> Float[Tensor, "n k"]:
    """f of equation (2), each row's sum 1."""
    square = roughness**4 + 1 / widest_sharpness(len(directions))  # α² and that of the directions' spacing
    nd = normals @ directions.T
    no = (normals * views).sum(1, keepdim=True)
    od = views @ directions.T
    upper = (nd > 0).to(nd.dtype)
    nd = nd.clamp_min(1e-6)
    nh2 = ((nd + no) ** 2 / (2 + 2 * od).clamp_min(1e-6)).clamp(0, 1)
    spread = nh2 * (square - 1) + 1
    root = torch.sqrt(square + (1 - square) * nd * nd)
    weight = upper * square / spread**2 * nd / (nd + root)
    return weight / weight.sum(1, keepdim=True).clamp_min(1e-12)


def kernel(
    directions: Float[Tensor, "k 3"], axis: Float[Tensor, "p 3"], sharpness: Float[Tensor, " p"]
) -> Float[Tensor, "k p"]:
    """L of the equations: lobes at the directions, widened, and no less than e^FAINTEST."""
    distance = torch.cdist(directions, axis, compute_mode="donot_use_mm_for_euclid_dist")
    return torch.exp((-0.5 * widened(sharpness, len(directions)) * distance**2).clamp_min(FAINTEST))


def widened(sharpness: Float[Tensor, " p"], count: int) -> Float[Tensor, " p"]:
    """κ of lobes seen through `count` directions."""
    return 1 / (1 / sharpness + 1 / widest_sharpness(count))


def seen_share(
    visibility: Float[Tensor, "n k"], weights: Float[Tensor, "n k"], lobes: Float[Tensor, "k p"]
) -> Float[Tensor, "n p"]:
    """v: of the light of `lobes` (their `kernel`) that `weights` reflect, the share that `visibility` lets pass."""
    return ((visibility * weights) @ lobes + LEAST) / (weights @ lobes + LEAST)
