"""Codes of surfaces that hide directions: the material that a ray hits, and its approximate normal there.

code = number of the material · BINS + number of the direction of `fibonacci_sphere(BINS)` nearest to the normal
NO_OCCLUDER  no surface is hit, or it is unknown
"""

import numpy as np
from jaxtyping import Float, Int, UInt16

from factorlib.geometry.sphere import fibonacci_sphere

BINS = 64  # number of normals
NO_OCCLUDER = 65535


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
