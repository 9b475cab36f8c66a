"""Pictures for display: 8-bit sRGB, deterministic PNG files, and a palette of materials.

The palette gives each material a distinct colour in masks and tables, as near to its own as possible.
"""

import base64
import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, UInt8
from PIL import Image
from PIL.ImageColor import getrgb
from scipy.optimize import linear_sum_assignment

from factorlib.images.exr import encode_pixels
from factorlib.images.tone import srgb_encode
from factorlib.reading import reading
from factorlib.wholefile import write_bytes

PERCENTILE = 99.0
PALETTE = (
    "#d1495b",
    "#2e8b57",
    "#3d6fb6",
    "#e0b13a",
    "#7d4f9e",
    "#3fb0c4",
    "#e07b39",
    "#8c6d46",
    "#9aa53a",
    "#e8e8e8",
    "#303438",
)


def exposure_of(
    radiance: Float[np.ndarray, "*batch 3"],
    mask: Bool[np.ndarray, "*batch"] | None = None,
    percentile: float = PERCENTILE,
) -> float:
    """Return the factor that takes the `percentile` of each pixel's brightest channel to white.

    It is 1 if there is no finite pixel, or if all are black.

    Args:
        radiance: Linear radiance.
        mask: Mask of the pixels that count.
        percentile: Percentile.

    Returns:
        The factor.

    >>> exposure_of(np.full((4, 4, 3), 0.25))
    4.0
    """
    brightest = np.asarray(radiance).max(axis=-1)
    brightest = brightest[np.isfinite(brightest) & (True if mask is None else mask)]
    white = float(np.percentile(brightest, percentile)) if brightest.size else 0.0
    return 1 / white if white > 0 else 1.0


def picture(radiance: Float[np.ndarray, "*batch 3"], exposure: float | None = None) -> UInt8[np.ndarray, "*batch 3"]:
    """Convert `radiance` (linear Rec. 709) times `exposure` to 8-bit sRGB, clipped; NaN is black.

    An exposure of None takes `exposure_of` the whole picture; pictures to be compared need the same number.

    >>> picture(np.array([[0.0, 0.18, 2.0]]), exposure=1.0).tolist()
    [[0, 118, 255]]
    """
    exposure = exposure_of(radiance) if exposure is None else exposure
    exposed = np.clip(np.nan_to_num(np.asarray(radiance) * exposure, nan=0.0, posinf=1.0, neginf=0.0), 0, 1)
    return np.rint(255 * srgb_encode(exposed)).astype(np.uint8)


def write_png(path: str | Path, pixels: UInt8[np.ndarray, "h w c"]) -> None:
    """Write the PNG of `png_bytes` atomically."""
    write_bytes(path, png_bytes(pixels))


def png_bytes(pixels: UInt8[np.ndarray, "h w c"]) -> bytes:
    """Encode an 8-bit PNG of 1, 3 or 4 channels (alpha not premultiplied), without date or program name."""
    pixels = np.asarray(pixels, dtype=np.uint8)
    # compression level 4 takes half the time of the default, 6, for 5 % more bytes
    return encode_pixels("picture.png", pixels, {"oiio:UnassociatedAlpha": 1, "png:compressionLevel": 4})


def write_gif(path: str | Path, frames: Sequence[UInt8[np.ndarray, "h w 4"]], seconds: float) -> None:
    """Write a looping animation on a white background, because GIF has no half-transparent pixels.

    Args:
        path: File to write.
        frames: Frames, RGBA.
        seconds: Duration of one loop.
    """
    solid = []
    for frame in frames:
        alpha = frame[..., 3:].astype(float) / 255
        solid.append(Image.fromarray(np.rint(frame[..., :3] * alpha + 255 * (1 - alpha)).astype(np.uint8)))
    memory = io.BytesIO()
    each = max(20, round(1000 * seconds / len(frames)))  # milliseconds; browsers slow down shorter frames
    solid[0].save(memory, "GIF", save_all=True, append_images=solid[1:], duration=each, loop=0, disposal=2)
    write_bytes(path, memory.getvalue())


def data_uri(pixels: UInt8[np.ndarray, "h w c"]) -> str:
    """Return pixels as a PNG in a `data:` URI, for HTML and glTF."""
    return "data:image/png;base64," + base64.b64encode(png_bytes(pixels)).decode("ascii")


def read_png(path: str | Path) -> UInt8[np.ndarray, "h w c"]:
    """Read the 8-bit pixels of a PNG of `write_png`; InputError if the file cannot be read."""
    with reading("a PNG", path), Image.open(path, formats=["PNG"]) as image:
        return np.atleast_3d(np.asarray(image))


def nearest_tags(names: list[str], reflectance: Float[np.ndarray, "m 3"]) -> dict[str, str]:
    """Assign palette colours to materials with the least total distance, mostly of chroma.

    With more than eleven materials the palette is used again.

    >>> nearest_tags(["wine", "snow", "coal"], np.array([[0.5, 0.05, 0.05], [0.8, 0.8, 0.8], [0.03, 0.03, 0.03]]))
    {'wine': '#d1495b', 'snow': '#e8e8e8', 'coal': '#303438'}
    """
    palette = np.array([getrgb(tag) for tag in PALETTE]) / 255
    tags = {}
    for start in range(0, len(names), len(PALETTE)):
        difference = srgb_encode(np.clip(reflectance[start : start + len(PALETTE)], 0, 1))[:, None] - palette
        # squared distance of chroma, plus a tenth of that of brightness
        brightness = difference.mean(axis=-1, keepdims=True)
        distance = 3 * np.square(difference - brightness).sum(axis=-1) + 0.3 * 3 * np.square(brightness[..., 0])
        for row, column in zip(*linear_sum_assignment(distance), strict=True):
            tags[names[start + row]] = PALETTE[column]
    return tags
