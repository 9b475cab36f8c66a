"""Radiance HDR (RGBE) files: eight bits a channel under one exponent, so a channel is off by up to 1/256 of the pixel's brightest."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import OpenImageIO as oiio
from jaxtyping import Float

from factorlib.images.write import write_image


def write_hdr(path: str | Path, radiance: Float[np.ndarray, "h w 3"]) -> None:
    """Write linear radiance, Rec. 709; what has no alpha and no name for its layout is read as a lat-long map by other programs."""
    pixels = np.asarray(radiance, dtype=np.float32)
    write_image(path, oiio.ImageSpec(pixels.shape[1], pixels.shape[0], 3, oiio.FLOAT), pixels)
