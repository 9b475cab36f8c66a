"""Fixed sets of directions."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float


def fibonacci_sphere(count: int) -> Float[np.ndarray, "count 3"]:
    """`count` nearly uniform unit directions.

    >>> bool(abs(fibonacci_sphere(100).mean()) < 1e-2)
    True
    """
    z = 1 - (2 * np.arange(count) + 1) / count
    turn = np.arange(count) * np.pi * (3 - np.sqrt(5))
    radius = np.sqrt(1 - z**2)
    return np.column_stack([radius * np.cos(turn), radius * np.sin(turn), z])
