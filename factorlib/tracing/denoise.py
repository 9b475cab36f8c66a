"""Noise taken out of path-traced pictures by Intel Open Image Denoise, where the package mitsuba-oidn is installed (the extra `denoise`).

It is a neural network that is given linear radiance, and as guides the albedo and the normal that each pixel shows, which have hardly any noise.
What fills a pixel in part is spread over all of it and over the pixels beside it before, so that no contour is blurred.
"""

import os
from importlib.metadata import version

import numpy as np
from jaxtyping import Float
from scipy.ndimage import distance_transform_edt

from factorlib.tracing.variant import mitsuba


def denoised(picture: Float[np.ndarray, "h w 10"]) -> Float[np.ndarray, "h w 4"]:
    """Linear radiance without noise, times coverage, and coverage, which stays as it is.

    picture: radiance, coverage, and the guides of `factorlib.tracing.scene.rendered`, all times coverage
    """
    os.environ["OIDN_DEFAULT_DEVICE"] = "cpu"  # also where there is a GPU: the same bytes
    mitsuba()  # whose thread pool it works in
    import mitsuba_oidn

    coverage = picture[..., 3:4]
    if not coverage.any():
        return picture[..., :4]
    row, column = distance_transform_edt(coverage[..., 0] <= 0, return_distances=False, return_indices=True)
    whole = (picture / np.where(coverage > 0, coverage, 1))[row, column].astype(np.float32)
    radiance, _, albedo, normal = map(np.ascontiguousarray, np.split(whole, [3, 4, 7], axis=-1))
    clean = mitsuba_oidn.denoise(radiance, albedo.clip(0, 1), normal, hdr=True, clean_aux=True)
    return np.concatenate([clean.clip(0) * coverage, coverage], axis=-1)


def denoiser() -> str:
    """The name and version of what `denoised` runs."""
    return f"mitsuba-oidn {version('mitsuba-oidn')}"
