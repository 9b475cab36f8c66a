"""Interreflection: light that arrives from hidden directions, sent by the surfaces that hide them.

    G_d,i = Σ_k w_ik (1 − V_ik) B_ik,                w_ik the cosine weights of factorlib.light.visibility, Σ_k w_ik = 1
    G_s,i = Σ_k D G1 G1 / (4 n·o) (1 − V_ik) B_ik Ω,   GGX of HIGHLIGHT_ROUGHNESS, Ω = 4π/K                         (1)

B_ik is the radiance of the surface that hides direction k from observation i.  It is taken from the photo itself: the
mean radiance of the observations of that material whose normals lie in that bin.  Few observations give an uncertain
mean.  It is therefore shrunk, with the weight of `PSEUDO_COUNT` observations, toward the mean of the whole material
with weights exp(NEARNESS n·b).  A bin without observations gets this mean alone.  An unknown
surface, or a material that the photo does not show, sends the photo's mean radiance.

B contains all bounces and is known, so G does not depend on materials or lights.  The model assumes that surfaces send
the same radiance toward the camera and toward each other.  Absolute reflectances become observable, because G does not
scale with the light.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from jaxtyping import Float

from factorlib.geometry.sphere import BINS, NO_OCCLUDER, fibonacci_sphere
from factorlib.light.visibility import cosine_weights, widest_sharpness
from factorlib.reflection.brdf import specular
from factorlib.robust import TINY
from factorlib.urm.observations import Observations

HIGHLIGHT_ROUGHNESS = (
    0.35  # roughness of the highlight that reflects hidden surfaces, for all materials; most have a few tenths
)
PSEUDO_COUNT = 3.0  # weight of the expected mean, in observations
NEARNESS = 4.0  # sharpness of the weights by normal
CHUNK_ROWS = 1024  # observations whose weights are in memory at once


def bounced_light(observations: Observations, radiance: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 6"] | None:
    """Return G_d and G_s of the n observations, in the unit of `radiance`; None without visibility and hit surfaces.

    Normals, views and directions are in the camera frame of each photo.
    """
    if observations.visibility is None or observations.occluder is None:
        return None
    incoming = np.zeros((len(observations), 6))
    hidden = observations.visibility.min(1) < 255
    for photo in np.unique(observations.photo):
        rows = np.flatnonzero(observations.photo == photo)
        surfaces = radiance_by_code(observations.take(rows), radiance[rows])
        shadowed = rows[hidden[rows]]
        for chunk in np.split(shadowed, range(CHUNK_ROWS, len(shadowed), CHUNK_ROWS)):
            incoming[chunk] = _bounced_from(observations.take(chunk), surfaces)
    return incoming


def radiance_by_code(observations: Observations, radiance: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "c+1 3"]:
    """Return B of every code of `Observations.occluder` in one photo; the last row is that of an unknown surface."""
    normal = unit_vectors(observations.normal)
    bins = fibonacci_sphere(BINS)
    photo_mean = np.average(radiance, axis=0, weights=observations.weight)
    by_code = np.tile(photo_mean, (len(observations.materials) * BINS + 1, 1))
    for m in np.unique(observations.material):
        selected = observations.material == m
        codes = slice(m * BINS, (m + 1) * BINS)
        by_code[codes] = _mean_by_bin(
            normal[selected] @ bins.T, radiance[selected], observations.weight[selected].astype(float)
        )
    return by_code


def _mean_by_bin(
    cosine: Float[np.ndarray, "n b"], radiance: Float[np.ndarray, "n 3"], weight: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "b 3"]:
    """Return the mean radiance of one material by bin of its normals.

    Args:
        cosine: Cosine of each normal with each bin's direction.
        radiance: Radiance of the n observations.
        weight: Weights of the n observations.
    """
    # expected mean of each bin, from all normals with weights exp(NEARNESS n·b)
    weights = np.exp(NEARNESS * cosine) * weight[:, None]
    expected = weights.T @ radiance / weights.sum(0)[:, None]
    bin_number = cosine.argmax(1)
    bins = cosine.shape[1]
    total = np.bincount(bin_number, weight, bins)
    mean = (
        np.column_stack([np.bincount(bin_number, weight * r, bins) for r in radiance.T])
        / np.maximum(total, TINY)[:, None]
    )
    # mean of the bin, shrunk toward the expected one
    count = np.bincount(bin_number, minlength=bins)[:, None]
    return (count * mean + PSEUDO_COUNT * expected) / (count + PSEUDO_COUNT)


def _bounced_from(observations: Observations, surfaces: Float[np.ndarray, "c+1 3"]) -> Float[np.ndarray, "n 6"]:
    """Return (1) at observations of one photo.

    The highlight is at least as wide as the spacing of the directions, as in `factorlib.light.visibility`.
    """
    hit_code = observations.occluder
    # `bounced_light` selects only such observations
    assert observations.visibility is not None and hit_code is not None
    count = observations.visibility.shape[1]
    unknown = len(surfaces) - 1
    directions = torch.from_numpy(fibonacci_sphere(count)).float()
    normal, view = (torch.from_numpy(unit_vectors(v)).float() for v in (observations.normal, observations.view))
    hidden = 1 - torch.from_numpy(observations.visibility).float() / 255
    alpha = torch.tensor(math.sqrt(HIGHLIGHT_ROUGHNESS**4 + 1 / widest_sharpness(count)))
    # GGX reflectance D G1 G1 / (4 n·o), times Ω
    nd = normal @ directions.T
    no = (normal * view).sum(1, keepdim=True)
    od = view @ directions.T
    nh = ((nd + no) / (2 + 2 * od).clamp_min(1e-6).sqrt()).clamp(0, 1)
    highlight = specular(alpha, nd, no, nh) * (4 * math.pi / count)
    code = np.where((hit_code == NO_OCCLUDER) | (hit_code >= unknown), unknown, hit_code).astype(np.int64)
    by_channel = [torch.from_numpy(surfaces[:, c]).float()[torch.from_numpy(code)] for c in range(3)]
    weights = [hidden * reflectance for reflectance in (cosine_weights(normal, directions), highlight)]
    return np.column_stack(
        [(weight * radiance).sum(1).double().numpy() for weight in weights for radiance in by_channel]
    )


def unit_vectors(vectors: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Return the vectors with length 1, as float64."""
    vectors = vectors.astype(float)
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
