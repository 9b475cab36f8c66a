"""Lat-long maps of lobes, and sampling, rotation and integration of such maps.

Texel averages: a texel holds the mean of the light over its area, so a sharp lobe loses no energy.  With polar angle θ
from +y and azimuth φ, the haversine formula gives 1 − ω·z = 2 sin²((θ−θ_z)/2) + 2 sin θ sin θ_z sin²((φ−φ_z)/2).  It is
exact at any sharpness, and its exponential is an outer product over rows and columns.  Every texel is integrated by
Gauss–Legendre nodes, as many as the lobe needs, and only where the lobe is not negligible.
"""

from collections.abc import Callable
from functools import cache

import numpy as np
from jaxtyping import Float

from factorlib.conventions import YUP_FROM_CAMERA, lat_long_directions, lat_long_of_direction, lat_long_solid_angles
from factorlib.light.lobes import Lobes

LARGEST_EXPONENT = 25.0  # a lobe below e⁻²⁵ of its peak is neglected
LEAST_NODES = 3  # Gauss nodes along a texel's side
NODES_PER_WIDTH = 1.5  # further nodes per lobe width 1/√λ in the texel's side

Map = Float[np.ndarray, "h w 3"]


def lat_long_of_lobes(lobes: Lobes, height: int, width: int) -> Map:
    """Return texel area averages of the light, [height, width, 3].

    The frame is that of the exported maps: the lobes' own frame turned y-up.
    """
    tall = np.pi / height
    wide = 2 * np.pi / width

    def nodes(sharpness: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return Gauss nodes θ of every row, φ of every column, and their weights."""
        node, share = gauss_nodes(LEAST_NODES + int(NODES_PER_WIDTH * max(tall, wide) * np.sqrt(sharpness)))
        return (np.arange(height)[:, None] + node) * tall, (np.arange(width)[:, None] + node) * wide, share

    return lattice_of_lobes(lobes, height, width, nodes)


def lattice_of_lobes(
    lobes: Lobes, height: int, width: int, nodes: Callable[[float], tuple[np.ndarray, np.ndarray, np.ndarray]]
) -> Map:
    """Return averages of the light over nodes of each row and column, [height, width, 3].

    The frame is the lobes' own frame turned y-up.

    Args:
        lobes: The light.
        height: Number of rows.
        width: Number of columns.
        nodes: Function of a sharpness that returns θ from the top [h, g], φ from the left edge [w, g] and weights [g].
    """
    result = np.zeros((height, width, 3))
    lobes = lobes.rotate(YUP_FROM_CAMERA)
    row, column = lat_long_of_direction(lobes.axis)
    bright = lobes.weight.any(axis=1)
    for theta, phi, sharpness, weight in zip(
        np.pi * row[bright], 2 * np.pi * column[bright], lobes.sharpness[bright], lobes.weight[bright], strict=True
    ):
        rows, columns, mean = _means(theta, phi, sharpness, *nodes(sharpness))
        result[rows[:, None], columns] += mean[..., None] * weight
    return result


def _means(
    theta_z: float, phi_z: float, sharpness: float, theta: np.ndarray, phi: np.ndarray, share: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the rows [r] and columns [c] that a unit lobe reaches, and its means there [r, c]."""
    # 1 − ω·z = polar + scale · azimuthal, by the haversine formula
    polar = 2 * np.sin((theta - theta_z) / 2) ** 2  # [h, g]
    rows = np.flatnonzero(sharpness * polar.min(axis=1) < LARGEST_EXPONENT)
    theta = theta[rows]
    polar = polar[rows]
    scale = 2 * np.sin(theta) * np.sin(theta_z)
    azimuthal = np.sin((phi - phi_z) / 2) ** 2  # [w, g]
    columns = np.flatnonzero(sharpness * scale.min(initial=2) * azimuthal.min(axis=1) < LARGEST_EXPONENT)
    # mean over φ [r, g, c], then mean over θ with the area element sin θ
    across = np.exp(-sharpness * scale[..., None, None] * azimuthal[columns]) @ share  # [r, g, c]
    area = share * np.maximum(np.sin(theta), 1e-12)  # a node may be a pole
    down = area / area.sum(axis=1, keepdims=True) * np.exp(-sharpness * polar)
    return rows, columns, np.einsum("rg,rgc->rc", down, across)


@cache
def gauss_nodes(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return nodes and weights of Gauss–Legendre quadrature over [0, 1]."""
    node, share = np.polynomial.legendre.leggauss(count)
    return (node + 1) / 2, share / 2


def map_energy(lat_long: Map) -> Float[np.ndarray, "3"]:
    """Return the integral of a map over the sphere, radiance × steradian."""
    return np.einsum("h,hwc->c", lat_long_solid_angles(*lat_long.shape[:2]), lat_long)


def sample_map(lat_long: Map, directions: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    """Interpolate a map bilinearly between texel centres.

    The directions are unit vectors in the map's frame.  The result is continuous over the poles.
    """
    height, width = lat_long.shape[:2]
    row, column = lat_long_of_direction(directions)
    # row and column in units of texels, the texel above and left, and the share of the next one
    i = row * height - 0.5
    j = column * width - 0.5
    i0 = np.floor(i).astype(int)
    j0 = np.floor(j).astype(int)
    a = (i - i0)[..., None]
    b = (j - j0)[..., None]
    pick = [[_texel(lat_long, i0 + di, j0 + dj) for dj in (0, 1)] for di in (0, 1)]
    return (1 - a) * ((1 - b) * pick[0][0] + b * pick[0][1]) + a * ((1 - b) * pick[1][0] + b * pick[1][1])


def _texel(lat_long: Map, i: np.ndarray, j: np.ndarray) -> np.ndarray:
    """Return texels by row and column; a row beyond a pole is the one before it, half a turn away."""
    height, width = lat_long.shape[:2]
    beyond = (i < 0) | (i >= height)
    i = np.where(i < 0, -1 - i, np.where(i >= height, 2 * height - 1 - i, i))
    return lat_long[i, (j + np.where(beyond, width // 2, 0)) % width]


def rotate_map(lat_long: Map, rotation: Float[np.ndarray, "3 3"], finer: int = 4) -> Map:
    """Return the map in another frame, each texel the mean of finer × finer samples.

    Args:
        lat_long: The map.
        rotation: new_from_old, both frames y-up.
        finer: Number of samples along a texel's side.
    """
    height, width = lat_long.shape[:2]
    directions = lat_long_directions(finer * height, finer * width)
    weight = np.repeat(lat_long_solid_angles(finer * height, finer * width)[:, None], finer * width, axis=1)
    fine = sample_map(lat_long, directions @ np.asarray(rotation)) * weight[..., None]

    def cells(values: np.ndarray) -> np.ndarray:
        """Return sums over the finer texels of each texel."""
        return values.reshape(height, finer, width, finer, -1).sum(axis=(1, 3))

    return cells(fine) / cells(weight)
