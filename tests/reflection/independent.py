"""An integrator that shares nothing with the product: the rendering equation summed over a fine grid of directions."""

import numpy as np


def frame(no: float, nz: float, oz: float):
    """n, o and z with the given cosines."""
    so = np.sqrt(1 - no**2)
    zx = (oz - no * nz) / so if so > 0 else np.sqrt(1 - nz**2)
    return np.array([0, 0, 1.0]), np.array([so, 0, no]), np.array([zx, np.sqrt(max(1 - nz**2 - zx**2, 0)), nz])


def directions(rows: int, columns: int):
    """Midpoints of equal-solid-angle cells of the upper hemisphere about +z, and a cell's solid angle."""
    c = (np.arange(rows) + 0.5) / rows
    phi = (np.arange(columns) + 0.5) / columns * 2 * np.pi
    s = np.sqrt(1 - c**2)[:, None]
    i = np.stack(np.broadcast_arrays(s * np.cos(phi), s * np.sin(phi), c[:, None]), -1)
    return i, 2 * np.pi / (rows * columns)


def brute_force(
    roughness: float, sharpness: float, no: float, nz: float, oz: float, size: int = 1500
) -> tuple[float, float]:
    """Diffuse and specular reflection of a unit lobe, the BRDF written out in vectors."""
    n, o, z = frame(no, nz, oz)
    i, cell = directions(size, 2 * size)
    light = np.exp(-0.5 * sharpness * ((i - z) ** 2).sum(-1)) * cell
    ni = i @ n
    h = i + o
    nh = (h @ n) / np.linalg.norm(h, axis=-1)
    a2 = roughness**4
    d = a2 / (np.pi * (nh**2 * (a2 - 1) + 1) ** 2)
    g = 1.0
    for c in (ni, n @ o):
        g = g * 2 * c / (c + np.sqrt(a2 + (1 - a2) * c**2))
    return float((light * ni).sum() / np.pi), float((light * d * g).sum() / (4 * (n @ o)))
