"""Transfer functions between encoded values in [0, 1] and linear radiance.

sRGB: IEC 61966-2-1:1999, section 5.2. All functions work on any shape and keep NaN. They continue as odd functions
below 0 and by the same formula above 1, so that they invert each other everywhere.
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

Values = Float[np.ndarray, "*shape"]


def srgb_decode(encoded: Values) -> Values:
    """Convert sRGB-encoded values to linear ones.

    >>> srgb_decode(np.array([0.0, 0.04045, 0.5, 1.0])).round(6).tolist()
    [0.0, 0.003131, 0.214041, 1.0]
    """
    size = np.abs(encoded)
    return np.copysign(np.where(size <= 0.04045, size / 12.92, ((size + 0.055) / 1.055) ** 2.4), encoded)


def srgb_encode(linear: Values) -> Values:
    """Convert linear values to sRGB-encoded ones.

    >>> srgb_encode(np.array([0.0, 0.0031308, 0.18, 1.0])).round(6).tolist()
    [0.0, 0.04045, 0.461356, 1.0]
    """
    size = np.abs(linear)
    return np.copysign(np.where(size <= 0.0031308, size * 12.92, 1.055 * size ** (1 / 2.4) - 0.055), linear)


def gamma_decode(encoded: Values) -> Values:
    """Return encoded^2.2."""
    return np.copysign(np.abs(encoded) ** 2.2, encoded)


def decoder(encoding: str) -> Callable[[Values], Values]:
    """Return the function from values of `encoding` (srgb, linear, gamma2.2) to linear ones."""
    decoders: dict[str, Callable[[Values], Values]]
    decoders = {"srgb": srgb_decode, "linear": np.asarray, "gamma2.2": gamma_decode}
    return decoders[encoding]
