"""The rendering equation as a plain sum over directions: the slow reference of Lambert + GGX, which shares nothing with the product."""

import numpy as np


def reflected(material, normals, views, incoming, light, seen=1.0) -> np.ndarray:
    """Radiance [n, 3] that surfaces send toward their views: Σ (k_d/π + k_s D G / (4 (n·i)(n·o))) max(n·i, 0) · light.

    material: any object with diffuse, specular, roughness;  normals, views: [n, 3], one frame with incoming [k, 3], the directions of light
    light: [k, 3], radiance times solid angle;  seen: [n, k], the share of it that arrives
    """
    ni, no, io = normals @ incoming.T, np.sum(normals * views, axis=1)[:, None], views @ incoming.T
    nh = (ni + no) / np.sqrt(np.maximum(2 + 2 * io, 1e-12))  # h = (i + o) / |i + o|
    square = material.roughness**4  # α²
    ni = np.maximum(ni, 0)
    highlight = square / (np.pi * (nh**2 * (square - 1) + 1) ** 2) * _smith(ni, square) * _smith(no, square) / (4 * no)
    matt, glossy = (seen * ni) @ light, (seen * highlight) @ light
    return np.array(material.diffuse) / np.pi * matt + np.array(material.specular) * glossy


def _smith(cosine, square):
    """G1."""
    return 2 * cosine / (cosine + np.sqrt(square + (1 - square) * cosine**2))
