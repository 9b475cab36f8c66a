"""Balls seen from the front, orthographically: every normal that faces the viewer, once.  The same picture is a reflectance map.

Frame: the photo's camera (x right, y down, z forward), view (0, 0, −1).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import binary_closing

from factorlib.conventions import FRONT
from factorlib.geometry.sphere import ball_normals
from factorlib.reflection.operator import MaterialLike
from factorlib.render.reflect import Reflector

GAP = 6  # cells: the widest gap between observed normals that counts as observed


def ball(reflector: Reflector, material: MaterialLike, size: int) -> Float[np.ndarray, "size size 3"]:
    """Radiance; zero beside the ball."""
    normals, inside = ball_normals(size)
    normals = normals * (1, -1, -1)  # in the camera's frame
    picture = np.zeros((size, size, 3))
    picture[inside] = reflector(material, normals, np.broadcast_to(FRONT, normals.shape))
    return picture


def observed_cells(normals: Float[np.ndarray, "n 3"], size: int) -> Bool[np.ndarray, "size size"]:
    """Pixels of a ball where a normal was seen; gaps as wide as the spacing of so few normals are closed."""
    cells = np.zeros((size, size), bool)
    if len(normals) == 0:
        return cells
    column, row = (np.clip(((normals[:, k] + 1) / 2 * size).astype(int), 0, size - 1) for k in (0, 1))
    cells[row, column] = True
    gap = int(np.clip(np.ceil(size / np.sqrt(len(normals))), 1, GAP))
    closed = binary_closing(np.pad(cells, gap), np.ones((3, 3)), iterations=gap)[gap:-gap, gap:-gap]
    return closed & ball_normals(size)[1]
