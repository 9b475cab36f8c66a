"""Image files by OpenImageIO, whole or not at all.

OpenImageIO leaves an EXR incomplete until its output object is deleted, and neither `close` nor the deletion say whether
the last bytes found room: so it writes to memory, and the bytes go to disk by a writer that does.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import OpenImageIO as oiio
from jaxtyping import Float

from factorlib.wholefile import bytes_of, write_bytes


def write_image(path: str | Path, spec: oiio.ImageSpec, pixels: np.ndarray) -> None:
    """Write `pixels` [h, w, c] in the format that the suffix of `path` names; raises OSError where that fails."""
    write_bytes(path, encoded(path, spec, pixels))


def encoded(name: str | Path, spec: oiio.ImageSpec, pixels: np.ndarray) -> bytes:
    """The bytes of an image file of `pixels` [h, w, c], in the format of the suffix of `name`; raises OSError where that fails."""

    def encode(memory: str) -> None:
        output = oiio.ImageOutput.create(str(name))
        if output is None:
            raise OSError(f"{name}: cannot be written: {oiio.geterror()}")
        written = output.open(memory, spec) and output.write_image(np.ascontiguousarray(pixels))
        error = output.geterror()
        closed = output.close()
        error = error or output.geterror()
        del output
        if not (written and closed):
            raise OSError(f"{name}: cannot be written: {error}")

    return bytes_of(encode)


def write_hdr(path: str | Path, radiance: Float[np.ndarray, "h w 3"]) -> None:
    """Write linear radiance, Rec. 709, as RGBE: a channel is off by up to 1/256 of the pixel's brightest.

    What has no alpha and no name for its layout is read as a lat-long map by other programs.
    """
    pixels = np.asarray(radiance, dtype=np.float32)
    write_image(path, oiio.ImageSpec(pixels.shape[1], pixels.shape[0], 3, oiio.FLOAT), pixels)
