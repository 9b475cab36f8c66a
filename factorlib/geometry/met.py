"""Codes of the surfaces that hide directions: which material a ray meets, and about which normal it has there.

code = number of the material · BINS + number of the direction of `fibonacci_sphere(BINS)` nearest to the normal
UNMET  nothing is met, or it is not known what
"""

import numpy as np
from jaxtyping import Float, Int, UInt16

from factorlib.geometry.sphere import fibonacci_sphere

BINS, UNMET = 64, 65535


def met_codes(material: Int[np.ndarray, " n"], normal: Float[np.ndarray, "n 3"]) -> UInt16[np.ndarray, " n"]:
    """Codes by number of the material (from 0; below 0: not known) and normal, unit, camera frame, on the side that is met.

    >>> met_codes(np.array([0, 2, -1]), np.array([[0.0, 0, 1], [0, 0, 1], [0, 0, 1]])).tolist()
    [0, 128, 65535]
    """
    nearest = np.argmax(normal @ fibonacci_sphere(BINS).T, axis=1)
    known = (material >= 0) & (material < UNMET // BINS)
    return np.where(known, material.astype(np.int64) * BINS + nearest, UNMET).astype(np.uint16)
