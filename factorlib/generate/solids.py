"""Shapes of the synthetic set: closed smooth surfaces about the origin, y up, about 1.2 units across.

Each is a grid of rows (from the top pole down) and columns (about the y axis), closed by one vertex at either pole. So
one routine triangulates them all and computes their smooth normals.
"""

from collections.abc import Callable
from functools import partial

import numpy as np
from jaxtyping import Float
from scipy.interpolate import PchipInterpolator

from factorlib.meshes.mesh import Mesh, closed_grid

ROWS = 60
COLUMNS = 96

# profile (radius, y) of a vase with lip, neck, belly and foot
VASE = (
    (0.0, 0.78),
    (0.22, 0.77),
    (0.33, 0.72),
    (0.31, 0.62),
    (0.29, 0.52),
    (0.38, 0.32),
    (0.55, 0.08),
    (0.60, -0.14),
    (0.55, -0.38),
    (0.42, -0.62),
    (0.36, -0.74),
    (0.28, -0.78),
    (0.0, -0.79),
)
# profile (radius, y) of a bottle with neck, shoulder and body
BOTTLE = (
    (0.0, 0.86),
    (0.12, 0.85),
    (0.16, 0.80),
    (0.155, 0.70),
    (0.16, 0.52),
    (0.24, 0.36),
    (0.38, 0.20),
    (0.43, 0.02),
    (0.43, -0.30),
    (0.43, -0.62),
    (0.41, -0.72),
    (0.34, -0.77),
    (0.0, -0.78),
)
# direction, height and sharpness of each bump
BUMPS = (
    ((0.8, 0.5, 0.3), 0.75, 3.5),
    ((-0.85, -0.15, 0.4), 0.40, 5.0),
    ((-0.15, 0.9, -0.4), 0.20, 5.0),
    ((0.25, -0.9, 0.3), 0.30, 3.0),
    ((0.2, 0.1, -0.95), 0.35, 4.0),
)


def sphere(radius: float = 0.6) -> Mesh:
    """Return a sphere."""
    return star(lambda direction: np.full(direction.shape[:-1], radius))


def blob(rows: int = ROWS, columns: int = COLUMNS) -> Mesh:
    """Return a smooth body without any symmetry: a ball with broad bumps of several heights."""

    def radius(direction: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n"]:
        """Return the distance of the surface from the origin in each direction."""
        size = np.full(direction.shape[:-1], 0.42)
        for axis, height, sharpness in BUMPS:
            axis = np.array(axis) / np.linalg.norm(axis)
            size += 0.45 * height * np.exp(sharpness * (direction @ axis - 1))
        return size

    return star(radius, rows, columns)


def star(radius: Callable[[np.ndarray], np.ndarray], rows: int = ROWS, columns: int = COLUMNS) -> Mesh:
    """Return the surface at distance `radius(direction [*n, 3]) -> [*n]` from the origin."""
    theta = np.arange(1, rows) / rows * np.pi
    phi = np.arange(columns) / columns * 2 * np.pi
    sin = np.sin(theta)[:, None]
    direction = np.stack(np.broadcast_arrays(sin * np.sin(phi), np.cos(theta)[:, None], sin * np.cos(phi)), axis=-1)
    poles = np.array([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]])
    return closed_grid(direction * radius(direction)[..., None], *(poles * radius(poles)[:, None]))


def revolve(profile: Float[np.ndarray, "n 2"]) -> Mesh:
    """Return the surface of revolution about y of a profile (radius, y), from the top pole to the bottom one."""
    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(profile, axis=0), axis=1))])
    curve = PchipInterpolator(length, profile)(np.arange(1, ROWS) / ROWS * length[-1])
    phi = np.arange(COLUMNS) / COLUMNS * 2 * np.pi
    radius = curve[:, :1]
    points = np.stack(np.broadcast_arrays(radius * np.sin(phi), curve[:, 1:], radius * np.cos(phi)), axis=-1)
    return closed_grid(points, np.array([0.0, profile[0, 1], 0.0]), np.array([0.0, profile[-1, 1], 0.0]))


SHAPES: dict[str, Callable[[], Mesh]] = {
    "sphere": sphere,
    "vase": partial(revolve, np.array(VASE)),
    "bottle": partial(revolve, np.array(BOTTLE)),
    "blob": blob,
}
