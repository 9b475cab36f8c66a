"""Denoising of path-traced pictures by Intel Open Image Denoise, if mitsuba-oidn is installed (the extra `denoise`).

The denoiser is a neural network. Its input is linear radiance and, as guides, the albedo and normal of each pixel,
which have hardly any noise. Before denoising, a partly covered pixel gets its foreground colour in full, and pixels
without coverage get that of the nearest covered one, so that no contour is blurred.
"""

import os
from importlib.metadata import version

import numpy as np
from jaxtyping import Float
from scipy.ndimage import distance_transform_edt

from factorlib.tracing.variant import mitsuba


def denoised(picture: Float[np.ndarray, "h w 10"]) -> Float[np.ndarray, "h w 4"]:
    """Denoise linear radiance times coverage; coverage is left unchanged.

    `picture` holds radiance, coverage, and the guides of `factorlib.tracing.scene.rendered`, all times coverage.
    """
    os.environ["OIDN_DEFAULT_DEVICE"] = "cpu"  # the same bytes with and without a GPU
    mitsuba()  # the denoiser uses its thread pool
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
    """Return name and version of the denoiser."""
    return f"mitsuba-oidn {version('mitsuba-oidn')}"
