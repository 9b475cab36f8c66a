"""Share of a lobe that reaches a surface point, from the visibility of a fixed set of directions.

A point reflects ∫ L(i) f(i) V(i) di.  f is the reflectance times the cosine, and V ∈ [0, 1] is the visible share of
direction i.  The reflection operator gives the integral without V.  The share that V leaves is estimated from K fixed
directions d_k:

    v = Σ_k V_k f_k L_k / Σ_k f_k L_k,       f_k = max(n·d_k, 0)             for the diffuse part                  (1)
                                             f_k = D(h_k) G1(n·d_k), GGX     for the specular part                (2)

L_k is the lobe at d_k.  V = 1 gives exactly 1, and a constant light gives the ambient occlusion.  V is known only at
the d_k, so no factor may be narrower than their spacing: a lobe's sharpness λ becomes κ = 1/(1/λ + 1/κ_K), and α²
grows likewise.  The two sums over k for all points and lobes are two matrix products.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

FAINTEST = -40.0  # least exponent of a lobe: products stay normal numbers, which multiply much faster
# Least share of the lobe that the reflectance passes; below it, the lobe is behind the surface and counts as visible.
LEAST = 1e-6


def widest_sharpness(count: int) -> float:
    """Return κ_K, the sharpness of a Gaussian whose width is half the spacing of `count` directions."""
    return count / math.pi


def cosine_weights(normals: Float[Tensor, "n 3"], directions: Float[Tensor, "k 3"]) -> Float[Tensor, "n k"]:
    """Return the weights of directions in diffuse reflection, f of (1), normalised to a sum of 1 in each row."""
    cosine = (normals @ directions.T).clamp_min(0)
    return cosine / cosine.sum(1, keepdim=True).clamp_min(1e-12)


def highlight_weights(
    normals: Float[Tensor, "n 3"], views: Float[Tensor, "n 3"], directions: Float[Tensor, "k 3"], roughness: float
) -> Float[Tensor, "n k"]:
    """Return the weights of directions in specular reflection, f of (2), normalised to a sum of 1 in each row.

    Args:
        normals: n of the points, unit.
        views: o of the points, unit, toward the camera.
        directions: d_k, unit.
        roughness: GGX roughness, α = roughness².
    """
    square = roughness**4 + 1 / widest_sharpness(len(directions))  # α² plus the variance of the directions' spacing
    nd = normals @ directions.T
    no = (normals * views).sum(1, keepdim=True)
    od = views @ directions.T
    # D(h_k) G1(n·d_k) up to a constant, 0 below the horizon
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
    """Return the values of widened lobes at directions, L of (1) and (2), at least e^FAINTEST.

    Args:
        directions: d_k, unit.
        axis: Axes of the lobes, unit.
        sharpness: λ of the lobes.
    """
    distance = torch.cdist(directions, axis, compute_mode="donot_use_mm_for_euclid_dist")
    return torch.exp((-0.5 * widened_sharpness(sharpness, len(directions)) * distance**2).clamp_min(FAINTEST))


def widened_sharpness(sharpness: Float[Tensor, " p"], count: int) -> Float[Tensor, " p"]:
    """Return κ, the sharpness of lobes that are widened for sampling at `count` directions."""
    return 1 / (1 / sharpness + 1 / widest_sharpness(count))


def visible_share(
    visibility: Float[Tensor, "n k"], weights: Float[Tensor, "n k"], lobes: Float[Tensor, "k p"]
) -> Float[Tensor, "n p"]:
    """Return v of (1) and (2), the share of each lobe's reflected light that is visible.

    Args:
        visibility: V of each point and direction, 0 to 1.
        weights: f of each point and direction.
        lobes: L of each direction and lobe, from `kernel`.
    """
    return ((visibility * weights) @ lobes + LEAST) / (weights @ lobes + LEAST)
