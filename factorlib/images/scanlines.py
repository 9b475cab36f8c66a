"""Open photos, of which some rows are read at a time, and a reader of those that OpenImageIO reads.

A camera's 48 megapixels are 576 MB as floating-point radiance. So a file is opened first, which gives its size, and its
rows are read in order, in chunks of any height. The size is checked before any pixel is read: a compressed picture of
one colour takes a thousandth of its size in memory, so a file of a few megabytes can need all memory of a machine.

For the formats of OpenImageIO (JPEG, PNG, TIFF, EXR, HDR), one channel is grey, and repeated; alpha is dropped. Integer
colours are taken as opened, not premultiplied by alpha; float colours (EXR) are premultiplied by convention.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import suppress
from math import ceil
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import OpenImageIO as oiio
from jaxtyping import Bool, Shaped

from factorlib.errors import InputError
from factorlib.reading import one_line

CLIPPED = 0.995  # least share of the white code that is clipped: JPEG compression disturbs the top code a little
WHITE = {oiio.UINT8: 2**8 - 1, oiio.UINT16: 2**16 - 1, oiio.UINT32: 2**32 - 1}
COPY = "copy it again from its source"
log = logging.getLogger("factorlib.images")
MOST_MEGAPIXELS = 200.0  # twice the number of the largest sensors
CHANNELS = 4  # greatest number of channels of an ordinary photo


class OpenPhoto(msgspec.Struct, frozen=True, kw_only=True):
    """Photo whose header has been read, and whose rows can be read in chunks.

    width, height  size as stored
    orientation    EXIF's, of the stored pixels: 1 as displayed, 2 to 4 mirrored or rotated by 180°, 5 to 8 transposed
    exif           EXIF tags by OpenImageIO's names
    profile        name of the colour profile, "" for none
    white          code of 1.0; None if the pixels are floats
    encoding       encoding that the format implies
    rows           (begin, end) -> those rows, which are requested in order, each at most once
    saturated      (begin, end) -> mask of saturated values in those rows; None: values with codes near white
    """

    width: int
    height: int
    orientation: int = 1
    exif: dict[str, Any]
    profile: str = ""
    white: int | None
    encoding: str
    rows: Callable[[int, int], Shaped[np.ndarray, "r w 3"]]
    saturated: Callable[[int, int], Bool[np.ndarray, "r w 3"]] | None = None

    @property
    def size(self) -> tuple[int, int]:
        """Height and width as displayed."""
        return (self.width, self.height) if self.orientation >= 5 else (self.height, self.width)

    def clipped(self, begin: int, end: int, codes: Shaped[np.ndarray, "r w 3"]) -> Bool[np.ndarray, "r w 3"]:
        """Return the mask of saturated values in rows that were read as `codes`.

        Args:
            begin: First row.
            end: End of the rows.
            codes: Codes of the rows.

        Returns:
            A mask.
        """
        if self.saturated is not None:
            return self.saturated(begin, end)
        return np.zeros(codes.shape, bool) if self.white is None else codes >= CLIPPED * self.white


def open_scanlines(path: str | Path, key: str | None) -> OpenPhoto:
    """Open a photo of a format that OpenImageIO reads; InputError if it is not an image of grey or RGB."""
    config = oiio.ImageSpec()
    config.attribute("oiio:UnassociatedAlpha", 1)
    source = oiio.ImageInput.open(str(path), config)
    if source is None:
        fault = f"not readable as an image ({one_line(oiio.geterror())})"
        raise InputError(
            fault, file=path, key=key, cure="the file is damaged or has a wrong suffix: copy or export it again"
        )
    spec = source.spec()
    colours = _colours(spec, path, key)
    first = min(colours)
    last = max(colours) + 1
    picked = [c - min(colours) for c in colours]

    def rows(begin: int, end: int) -> Shaped[np.ndarray, "r w 3"]:
        """Read rows begin … end − 1; from a tiled file, the rows of tiles that contain them are read."""
        if tall := spec.tile_height:
            top = begin // tall * tall
            bottom = min(-(-end // tall) * tall, spec.height)
            box = (spec.x, spec.x + spec.width, spec.y + top, spec.y + bottom, spec.z, spec.z + 1)
            pixels = source.read_tiles(*box, first, last, spec.format)
        else:
            top = begin
            pixels = source.read_scanlines(spec.y + begin, spec.y + end, 0, first, last, spec.format)
        error = source.geterror()
        if pixels is None or "Premature end" in error:
            raise InputError(f"truncated or damaged ({one_line(error)})", file=path, key=key, cure=COPY)
        if error:
            log.warning("%s: %s", path, one_line(error))
        return pixels.reshape(-1, spec.width, last - first)[begin - top : end - top, :, picked]

    orientation = spec.get_int_attribute("Orientation", 1)
    white = WHITE.get(spec.format.basetype)
    return OpenPhoto(
        width=spec.width,
        height=spec.height,
        orientation=orientation if 1 <= orientation <= 8 else 1,
        exif={a.name: a.value for a in spec.extra_attribs},
        profile=spec.get_string_attribute("ICCProfile:profile_description"),
        white=white,
        encoding="linear" if white is None else "srgb",
        rows=rows,
    )


def _colours(spec: oiio.ImageSpec, path: str | Path, key: str | None) -> list[int]:
    """Return the indices of the red, green and blue channels, equal for grey; InputError if there are neither."""
    names = list(spec.channelnames)
    if set("RGB") <= set(names):
        return [names.index(name) for name in "RGB"]
    colours = [index for index in range(len(names)) if index != spec.alpha_channel and names[index] != "Z"]
    if len(colours) != 1:
        raise InputError(
            f"has the channels {', '.join(names)}: neither grey nor RGB",
            file=path,
            key=key,
            cure="save it as RGB or grey, in one layer",
        )
    return 3 * colours


def check_pixels(size: tuple[int, int], most_megapixels: float, path: str | Path, key: str | None = None) -> None:
    """Check the size (height, width) of a picture.

    Args:
        size: Height and width.
        most_megapixels: Limit.
        path: File to name in the error.
        key: Key to name in the error.

    Raises:
        InputError: If it has more pixels.

    >>> check_pixels((30_000, 30_000), 200.0, "kitchen.png")
    Traceback (most recent call last):
    factorlib.errors.InputError: kitchen.png: has 30000 × 30000 pixels, 900 megapixels; at most 200 are read
      make photo and masks smaller, or allow it: SET="masks.most_megapixels=900"
    """
    height, width = size
    millions = height * width / 1e6
    if millions > most_megapixels:
        raise InputError(
            f"has {width} × {height} pixels, {millions:.4g} megapixels; at most {most_megapixels:g} are read",
            file=path,
            key=key,
            cure=f'make photo and masks smaller, or allow it: SET="masks.most_megapixels={ceil(millions)}"',
        )


def check_values(path: str | Path, most_megapixels: float = MOST_MEGAPIXELS, key: str | None = None) -> None:
    """Check that an image file has at most as many values as the largest photo has with CHANNELS channels.

    A file that is not an image, or of a kind that OpenImageIO does not read, passes: its reader rejects it.

    Args:
        path: File.
        most_megapixels: Limit of a photo.
        key: Key to name in the error.

    Raises:
        InputError: If it has more values.
    """
    source = oiio.ImageInput.open(str(path))
    if source is None:
        with suppress(UnicodeError):  # the message about a damaged file may be no UTF-8
            oiio.geterror()  # clear the error
        return
    spec = source.spec()
    millions = spec.width * spec.height * spec.nchannels / 1e6
    source.close()
    if millions > CHANNELS * most_megapixels:
        raise InputError(
            f"has {spec.width} × {spec.height} pixels of {spec.nchannels} channels, {millions:,.0f} million values",
            file=path,
            key=key,
            cure=f"make it smaller, or leave channels out: at most {CHANNELS * most_megapixels:,.0f} million are read",
        )
