"""A photo's tone curve: what its file makes of linear radiance, beyond the encoding it declares.

Cameras render: they raise contrast, or lift shadows.  What is left after undoing the declared encoding is modelled by one
exponent g per photo,

    τ(x) = ((x + ε)^g − ε^g) / ((1 + ε)^g − ε^g),

with x in units of the illumination's mean radiance.  τ(0) = 0 and τ(1) = 1, so that g does not trade with exposure; ε keeps the
slope at black finite, as the straight toe of sRGB does.  What photos share tells g: two materials have one ratio of
reflectances in all of them.
"""

import numpy as np
from jaxtyping import Float

TOE = 0.02  # ε


def curve(x: Float[np.ndarray, "*n"], exponent: Float[np.ndarray, "*n"] | float) -> Float[np.ndarray, "*n"]:
    """τ(x) of x ≥ 0."""
    return ((x + TOE) ** exponent - TOE**exponent) / _range(exponent)


def inverse(y: Float[np.ndarray, "*n"], exponent: Float[np.ndarray, "*n"] | float) -> Float[np.ndarray, "*n"]:
    """x ≥ 0 with τ(x) = y, and 0 for y < 0."""
    return (np.maximum(y, 0.0) * _range(exponent) + TOE**exponent) ** (1 / exponent) - TOE


def slope(x: Float[np.ndarray, "*n"], exponent: Float[np.ndarray, "*n"] | float) -> Float[np.ndarray, "*n"]:
    """dτ/dx."""
    return exponent * (x + TOE) ** (exponent - 1) / _range(exponent)


def by_log_exponent(x: Float[np.ndarray, "*n"], exponent: Float[np.ndarray, "*n"] | float) -> Float[np.ndarray, "*n"]:
    """dτ/d log g."""
    at_x, at_black, at_one = (end**exponent * np.log(end) for end in (x + TOE, TOE, 1 + TOE))
    return exponent * (at_x - at_black - curve(x, exponent) * (at_one - at_black)) / _range(exponent)


def shown(radiance: Float[np.ndarray, "*n"], exponent: float, pivot: float) -> Float[np.ndarray, "*n"]:
    """What a photo shows of linear radiance, where radiance `pivot` stays what it is."""
    return pivot * curve(radiance / pivot, exponent)


def straightened(radiance: Float[np.ndarray, "*n"], exponent: float, pivot: float) -> Float[np.ndarray, "*n"]:
    """The inverse of `shown`."""
    return pivot * inverse(radiance / pivot, exponent)


def _range(exponent: Float[np.ndarray, "*n"] | float) -> Float[np.ndarray, "*n"] | float:
    return (1 + TOE) ** exponent - TOE**exponent
