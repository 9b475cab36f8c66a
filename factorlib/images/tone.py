"""Transfer functions between encoded values and linear radiance, and the tone curve of a photo beyond them.

Transfer functions (sRGB: IEC 61966-2-1:1999, section 5.2) work on any shape and keep NaN. They continue as odd
functions below 0 and by the same formula above 1, so that they invert each other everywhere.

Cameras render: they raise contrast, or lift shadows. The mapping that remains after the declared encoding is undone is
modelled by one exponent g per photo,

    τ(x) = ((x + ε)^g − ε^g) / ((1 + ε)^g − ε^g),                                                               (1)

with x in units of the illumination's mean radiance. τ(0) = 0 and τ(1) = 1, so that g is independent of exposure; ε
keeps the slope at black finite, as the straight toe of sRGB does. The photos together determine g: two materials have
one ratio of reflectances in all of them.
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

TOE = 0.02  # ε


def curve(x: Float[np.ndarray, "*n"], exponent: Float[np.ndarray, "*n"] | float) -> Float[np.ndarray, "*n"]:
    """Return τ(x), the tone curve (1), for x ≥ 0."""
    return ((x + TOE) ** exponent - TOE**exponent) / _range(exponent)


def inverse(y: Float[np.ndarray, "*n"], exponent: Float[np.ndarray, "*n"] | float) -> Float[np.ndarray, "*n"]:
    """Return x ≥ 0 with τ(x) = y, the inverse of the tone curve (1); 0 for y < 0."""
    return (np.maximum(y, 0.0) * _range(exponent) + TOE**exponent) ** (1 / exponent) - TOE


def slope(x: Float[np.ndarray, "*n"], exponent: Float[np.ndarray, "*n"] | float) -> Float[np.ndarray, "*n"]:
    """Return dτ/dx, the slope of the tone curve (1)."""
    return exponent * (x + TOE) ** (exponent - 1) / _range(exponent)


def by_log_exponent(x: Float[np.ndarray, "*n"], exponent: Float[np.ndarray, "*n"] | float) -> Float[np.ndarray, "*n"]:
    """Return dτ/d log g, the derivative of the tone curve (1) with respect to its log exponent."""
    term_x, term_black, term_one = (end**exponent * np.log(end) for end in (x + TOE, TOE, 1 + TOE))
    rise = term_x - term_black - curve(x, exponent) * (term_one - term_black)
    return exponent * rise / _range(exponent)


def apply_tone(radiance: Float[np.ndarray, "*n"], exponent: float, pivot: float) -> Float[np.ndarray, "*n"]:
    """Apply the tone curve to linear radiance; radiance `pivot` is unchanged.

    Args:
        radiance: Linear radiance.
        exponent: Exponent g.
        pivot: Unit of x in (1).

    Returns:
        Values of the photo.
    """
    return pivot * curve(radiance / pivot, exponent)


def invert_tone(radiance: Float[np.ndarray, "*n"], exponent: float, pivot: float) -> Float[np.ndarray, "*n"]:
    """Undo the tone curve of a photo, the inverse of `apply_tone`.

    Args:
        radiance: Values of the photo.
        exponent: Exponent g.
        pivot: Unit of x in (1).

    Returns:
        Linear radiance.
    """
    return pivot * inverse(radiance / pivot, exponent)


def _range(exponent: Float[np.ndarray, "*n"] | float) -> Float[np.ndarray, "*n"] | float:
    """Return the denominator of (1)."""
    return (1 + TOE) ** exponent - TOE**exponent


Values = Float[np.ndarray, "*shape"]
Curve = Callable[[Values], Values]  # from encoded values to linear ones


def srgb_decode(encoded: Values) -> Values:
    """Convert sRGB-encoded values to linear ones.

    >>> srgb_decode(np.array([0.0, 0.04045, 0.5, 1.0])).round(7).tolist()
    [0.0, 0.0031308, 0.2140411, 1.0]
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


def power_decode(exponent: float) -> Curve:
    """Return the function from encoded values to linear ones, encoded^exponent, continued as an odd function."""
    return lambda encoded: np.copysign(np.abs(encoded) ** exponent, encoded)


# curves by the name of the encoding
DECODERS: dict[str, Curve] = {"srgb": srgb_decode, "linear": np.asarray, "gamma2.2": power_decode(2.2)}
