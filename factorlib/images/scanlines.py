"""A photo's pixels as its file stores them: an open file, of which some rows are read at a time; those that OpenImageIO reads.

A camera's 48 megapixels are 576 MB as floating-point radiance.  So a file is opened first, which tells its size, and its rows
are read in order, as many at once as one likes.

Of what OpenImageIO reads (JPEG, PNG, TIFF, EXR, HDR), one channel is grey, and repeated; alpha is dropped.  Integer colours are
taken as stored, without the alpha multiplied in; float colours (EXR) are premultiplied by convention and are taken so.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import OpenImageIO as oiio
from jaxtyping import Bool, Shaped

from factorlib.errors import InputError
from factorlib.reading import one_line

CLIPPED = 0.995  # of the white code: JPEG compression ripples the top code a little
WHITE = {oiio.UINT8: 2**8 - 1, oiio.UINT16: 2**16 - 1, oiio.UINT32: 2**32 - 1}
COPY = "copy it again from where it came"
log = logging.getLogger("factorlib.images")


class Stored(msgspec.Struct, frozen=True, kw_only=True):
    """An open photo.

    width, height  as stored
    orientation    EXIF's, of the stored pixels: 1 as they are displayed, 2-4 mirrored or half turned, 5-8 lying on a side
    exif           what the camera wrote, by OpenImageIO's names
    profile        name of the colour profile, "" for none
    white          the code of 1.0; None where the pixels are floats
    encoding       what this kind of file implies
    rows           (begin, end) -> those rows, which are asked for in order, each at most once
    saturated      (begin, end) -> where those rows hold less than there was to see; None: where codes are near white
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
        """(height, width) as displayed."""
        return (self.width, self.height) if self.orientation >= 5 else (self.height, self.width)

    def clipped(self, begin: int, end: int, codes: Shaped[np.ndarray, "r w 3"]) -> Bool[np.ndarray, "r w 3"]:
        """Return where rows that were read as `codes` hold less than there was to see."""
        if self.saturated is not None:
            return self.saturated(begin, end)
        return np.zeros(codes.shape, bool) if self.white is None else codes >= CLIPPED * self.white


def open_scanlines(path: str | Path, key: str | None) -> Stored:
    """Raises InputError for a file that is no image, or holds no grey or RGB."""
    wish = oiio.ImageSpec()
    wish.attribute("oiio:UnassociatedAlpha", 1)
    source = oiio.ImageInput.open(str(path), wish)
    if source is None:
        fault = f"not readable as an image ({one_line(oiio.geterror())})"
        raise InputError(fault, file=path, key=key, cure="is it whole, and of the kind its suffix says?")
    spec = source.spec()
    colours = _colours(spec, path, key)
    first, last, picked = min(colours), max(colours) + 1, [c - min(colours) for c in colours]

    def rows(begin: int, end: int) -> Shaped[np.ndarray, "r w 3"]:
        """Rows begin … end − 1; of a file of tiles, the rows of tiles that these lie in are read."""
        if tall := spec.tile_height:
            top, bottom = begin // tall * tall, min(-(-end // tall) * tall, spec.height)
            box = (spec.x, spec.x + spec.width, spec.y + top, spec.y + bottom, spec.z, spec.z + 1)
            pixels = source.read_tiles(*box, first, last, spec.format)
        else:
            top, pixels = begin, source.read_scanlines(spec.y + begin, spec.y + end, 0, first, last, spec.format)
        error = source.geterror()
        if pixels is None or "Premature end" in error:
            raise InputError(f"truncated or damaged ({one_line(error)})", file=path, key=key, cure=COPY)
        if error:
            log.warning("%s: %s", path, one_line(error))
        return pixels.reshape(-1, spec.width, last - first)[begin - top : end - top, :, picked]

    orientation, white = spec.get_int_attribute("Orientation", 1), WHITE.get(spec.format.basetype)
    return Stored(
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
    """The channels that are red, green and blue; thrice the same where there is only grey."""
    names = list(spec.channelnames)
    if set("RGB") <= set(names):
        return [names.index(name) for name in "RGB"]
    colours = [index for index in range(len(names)) if index != spec.alpha_channel and names[index] != "Z"]
    if len(colours) != 1:
        cure = "save it as RGB or grey, in one layer"
        raise InputError(f"has the channels {', '.join(names)}", file=path, key=key, cure=cure)
    return 3 * colours
