"""The tone curves of a light's photos (`factorlib.images.tone`), one exponent a photo; the identity where the light has none."""

from __future__ import annotations

import msgspec
import numpy as np
from jaxtyping import Float, Int

from factorlib.images.tone import curve, inverse, slope
from factorlib.model.bounds import TONE
from factorlib.model.lights import Light

NEAR_BOUNDS = 0.8  # of the logarithms of the exponents' bounds


def toned(linear: Float[np.ndarray, "n c"], light: Light, photo: Int[np.ndarray, " n"]) -> Float[np.ndarray, "n c"]:
    """What the photos show of linear radiance."""
    return linear if len(light.log_tone) == 0 else curve(np.maximum(linear, 0.0), exponents(light, photo))


def straightened(
    radiance: Float[np.ndarray, "n c"], light: Light, photo: Int[np.ndarray, " n"]
) -> Float[np.ndarray, "n c"]:
    """Linear radiance, from what the photos show.  The inverse of `toned`."""
    return radiance if len(light.log_tone) == 0 else inverse(radiance, exponents(light, photo))


def slope_at(
    radiance: Float[np.ndarray, "n c"], light: Light, photo: Int[np.ndarray, " n"]
) -> Float[np.ndarray, "n c"] | float:
    """Derivative of what a photo shows by linear radiance, where it shows `radiance`."""
    if len(light.log_tone) == 0:
        return 1.0
    return slope(straightened(radiance, light, photo), exponents(light, photo))


def exponents(light: Light, photo: Int[np.ndarray, " n"]) -> Float[np.ndarray, "n 1"]:
    """The exponent of the photo of each of n observations."""
    return np.exp(light.log_tone)[photo][:, None]


def with_curves(light: Light) -> Light:
    """The light with a curve for each photo, the identity."""
    return msgspec.structs.replace(light, log_tone=np.zeros_like(light.log_exposure))


def beyond_cameras(light: Light) -> bool:
    """Whether an exponent has run near the bounds of what cameras do."""
    low, high = NEAR_BOUNDS * np.log(TONE)
    return bool(((light.log_tone < low) | (light.log_tone > high)).any())
