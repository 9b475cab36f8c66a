"""Film grain of a photo: the noise of its pixels, and noise like it.

Noise is measured in sRGB-encoded values, where it depends little on brightness.  The diagonal detail of 2 × 2 pixels,
(a − b − c + d)/2, has the covariance of the noise over the channels and little of the picture itself.  Its scale is the
median absolute value over 0.6745 (Donoho and Johnstone, "Ideal spatial adaptation by wavelet shrinkage", 1994), and
detail of more than OUTLIER scales, at edges, does not count.
"""

import numpy as np
from jaxtyping import Float

from factorlib.images.tone import srgb_decode, srgb_encode

OUTLIER = 3.0
DARKEST = 0.02  # least encoded value that counts: below it, noise is cut off
BRIGHTEST = 0.98  # largest one, over the picture's largest

Picture = Float[np.ndarray, "h w 3"]


def grain_covariance(photo: Picture) -> Float[np.ndarray, "3 3"]:
    """Return the covariance of the noise over the channels, in sRGB-encoded values; `photo` is linear."""
    height, width = photo.shape[0] // 2 * 2, photo.shape[1] // 2 * 2
    encoded = srgb_encode(photo[:height, :width])
    corners = np.stack([encoded[i::2, j::2] for i in (0, 1) for j in (0, 1)])
    usable = ((corners > DARKEST) & (corners < BRIGHTEST * encoded.max(initial=0))).all(axis=(0, 3))
    detail = np.einsum("k,khwc->hwc", [0.5, -0.5, -0.5, 0.5], corners)[usable]
    if len(detail) == 0:
        return np.zeros((3, 3))
    scale = np.median(np.abs(detail), axis=0) / 0.6745
    detail = detail[(np.abs(detail) <= OUTLIER * scale).all(axis=1)]
    return detail.T @ detail / len(detail)


def add_grain(radiance: Picture, photo: Picture, share: Float[np.ndarray, "h w"], seed: int = 1) -> Picture:
    """Return linear radiance with the photo's grain.

    Args:
        radiance: a picture without noise, in the photo's units
        photo: the photo
        share: weight of the grain in each pixel; pixels of weight 0 are unchanged
        seed: seed of the random numbers
    """
    size, axes = np.linalg.eigh(grain_covariance(photo))
    noise = np.random.default_rng(seed).standard_normal(radiance.shape) * np.sqrt(size.clip(0)) @ axes.T
    grainy = srgb_decode(srgb_encode(radiance) + share[..., None] * noise)
    return np.where(share[..., None] > 0, np.maximum(grainy, 0), radiance)
