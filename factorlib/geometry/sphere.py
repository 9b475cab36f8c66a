"""Directions: evenly spread ones, mirror directions, cells of similar ones, and codes of surfaces that hide them.

A code is the number of the hiding material · BINS + the number of the direction of `fibonacci_sphere(BINS)` nearest to
the normal of the surface that a ray hits; NO_OCCLUDER stands for no surface, or an unknown one.
"""

import numpy as np
from jaxtyping import Bool, Float, Int, UInt16

Vectors = Float[np.ndarray, "*n 3"]
BINS = 64  # number of normals in codes
NO_OCCLUDER = 65535


def fibonacci_sphere(count: int) -> Float[np.ndarray, "count 3"]:
    """Return `count` nearly uniform unit directions.

    >>> bool(abs(fibonacci_sphere(100).mean()) < 1e-2)
    True
    """
    z = 1 - (2 * np.arange(count) + 1) / count
    turn = np.arange(count) * np.pi * (3 - np.sqrt(5))
    radius = np.sqrt(1 - z**2)
    return np.column_stack([radius * np.cos(turn), radius * np.sin(turn), z])


def mirror_directions(normal: Vectors, view: Vectors) -> Vectors:
    """Return mirror directions 2(n·o)n − o, the directions of incident light of a mirror; all unit, in one frame."""
    return 2 * np.sum(normal * view, axis=-1, keepdims=True) * normal - view


def mirror_cells(normal: Vectors, view: Vectors, size: float) -> Int[np.ndarray, " n"]:
    """Return the number of the cell that contains each observation's mirror direction; cells are cubes.

    Args:
        normal: Unit normals.
        view: Unit directions to the viewer.
        size: Side of a cell.

    Returns:
        A number for each observation.
    """
    return np.floor((mirror_directions(normal, view) + 1) / size).astype(int) @ [1, 1_000, 1_000_000]


def direction_cells(direction: Float[np.ndarray, "n 3"], size: float) -> Int[np.ndarray, "n 3"]:
    """Return cells of roughly `size` radians, by an octahedral map of the sphere that is cut into squares."""
    x, y, z = np.moveaxis(direction / np.abs(direction).sum(-1, keepdims=True), -1, 0)
    fold = z > 0  # the viewer's hemisphere (z < 0) is the connected middle of the map
    u = np.where(fold, (1 - np.abs(y)) * np.sign(x), x)
    v = np.where(fold, (1 - np.abs(x)) * np.sign(y), y)
    step = size / np.sqrt(np.pi)  # the square of area 4 covers 4π steradians
    return np.floor(np.column_stack([u, v, fold]) / np.array([step, step, 1.0])).astype(np.int64)


def ball_normals(size: int) -> tuple[Float[np.ndarray, "n 3"], Bool[np.ndarray, "size size"]]:
    """Return the normals of a ball that fills a picture, and a mask of its pixels.

    A pixel belongs to the ball if its centre does; +y is up, +z points toward the viewer.

    >>> ball_normals(1)[0].tolist()
    [[0.0, -0.0, 1.0]]
    """
    centres = (np.arange(size) + 0.5) / size * 2 - 1
    x, y = np.meshgrid(centres, -centres)
    inside = x * x + y * y < 1
    x = x[inside]
    y = y[inside]
    return np.stack([x, y, np.sqrt(1 - x * x - y * y)], axis=-1), inside


def occluder_codes(material: Int[np.ndarray, " n"], normal: Float[np.ndarray, "n 3"]) -> UInt16[np.ndarray, " n"]:
    """Return the codes of materials and normals.

    `material` counts from 0; negative numbers are unknown. `normal` is unit, in the camera frame, on the side that is
    hit.

    >>> occluder_codes(np.array([0, 2, -1]), np.array([[0.0, 0, 1], [0, 0, 1], [0, 0, 1]])).tolist()
    [0, 128, 65535]
    """
    nearest = np.argmax(normal @ fibonacci_sphere(BINS).T, axis=1)
    known = (material >= 0) & (material < NO_OCCLUDER // BINS)
    return np.where(known, material.astype(np.int64) * BINS + nearest, NO_OCCLUDER).astype(np.uint16)
