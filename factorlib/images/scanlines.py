"""Open photos, of which some rows are read at a time, and a reader of those that OpenImageIO reads.

A camera's 48 megapixels are 576 MB as floating-point radiance. So a file is opened first, which gives its size, and its
rows are read in order, in chunks of any height. The size is checked before any pixel is read: a compressed picture of
one colour takes a thousandth of its size in memory, so a file of a few megabytes can need all memory of a machine.

For the formats of OpenImageIO (JPEG, PNG, TIFF, EXR, HDR), one channel is grey, and repeated; alpha is dropped. Integer
colours are taken as opened, not premultiplied by alpha; float colours (EXR) are premultiplied by convention. Float
colours of other primaries are converted to Rec. 709 without adaptation of white. An EXR has the size of its display
window.
"""

from __future__ import annotations

import logging
import re
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
from factorlib.reading import one_line, reading

CLIPPED = 0.995  # least share of the white code that is clipped: JPEG compression disturbs the top code a little
WHITE = {oiio.UINT8: 2**8 - 1, oiio.UINT16: 2**16 - 1, oiio.UINT32: 2**32 - 1}
REC709 = np.array([[0.64, 0.33], [0.3, 0.6], [0.15, 0.06], [0.3127, 0.329]])  # red, green, blue, white: x, y
SAME_CHROMATICITY = 1e-3  # primaries that differ by less are the same
LARGEST_GAIN = 100.0  # greatest factor between primaries; damaged ones have more
HEADER = 4096  # number of bytes that hold the header of a Radiance file
COPY = "copy it again from its source"
log = logging.getLogger("factorlib.images")
MOST_MEGAPIXELS = 200.0  # twice the number of the largest sensors
CHANNELS = 4  # greatest number of channels of an ordinary photo
Rows = Callable[[int, int], Shaped[np.ndarray, "r w 3"]]


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
    rows: Rows
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
    size = (spec.height, spec.width) if white else (spec.full_height, spec.full_width)
    return OpenPhoto(
        width=size[1],
        height=size[0],
        orientation=orientation if 1 <= orientation <= 8 else 1,
        exif={a.name: a.value for a in spec.extra_attribs},
        profile=spec.get_string_attribute("ICCProfile:profile_description"),
        white=white,
        encoding="linear" if white is None else "srgb",
        rows=rows if white else _in_rec709(_in_display_window(rows, spec), spec, path),
    )


def _in_display_window(rows: Rows, spec: oiio.ImageSpec) -> Rows:
    """Return the reader of rows of an EXR's display window: NaN where its data window does not reach."""
    down = spec.y - spec.full_y
    right = spec.x - spec.full_x
    if (down, right, spec.height, spec.width) == (0, 0, spec.full_height, spec.full_width):
        return rows

    def displayed(begin: int, end: int) -> Shaped[np.ndarray, "r w 3"]:
        """Read rows begin … end − 1 of the display window."""
        result = np.full((end - begin, spec.full_width, 3), np.nan, np.float32)
        first = min(max(begin - down, 0), spec.height)
        last = min(max(end - down, first), spec.height)
        columns = slice(max(-right, 0), max(spec.full_width - right, 0))
        if last > first and (pixels := rows(first, last)[:, columns]).size:
            left = max(right, 0)
            result[first + down - begin : last + down - begin, left : left + pixels.shape[1]] = pixels
        return result

    return displayed


def _in_rec709(rows: Rows, spec: oiio.ImageSpec, path: str | Path) -> Rows:
    """Return the reader of rows in linear Rec. 709; colours beyond it have negative values.

    Primaries are EXR's attribute `chromaticities`, Radiance's line PRIMARIES, or else Rec. 709's, as where all of them
    are 0. They need not be colours: ACES' blue has a negative y.
    """
    with Path(path).open("rb") as stream:
        line = re.match(rb"#\?[\S\s]*?\nPRIMARIES=([^\n]*)\n", stream.read(HEADER))
    given = spec.getattribute("chromaticities") or (line[1].split() if line else REC709)
    with reading("eight chromaticities of primaries", path, cure="write it again without them"):
        primaries = np.array(given, float).reshape(4, 2)
        if not primaries.any() or np.abs(primaries - REC709).max() < SAME_CHROMATICITY:
            return rows
        matrix = (np.linalg.inv(_xyz_from_rgb(REC709)) @ _xyz_from_rgb(primaries)).astype(np.float32)
        if not np.abs(matrix).max() < LARGEST_GAIN:
            raise ValueError("they span no colours")
    return lambda begin, end: rows(begin, end).astype(np.float32) @ matrix.T


def _xyz_from_rgb(primaries: Shaped[np.ndarray, "4 2"]) -> Shaped[np.ndarray, "3 3"]:
    """Return the matrix of primaries whose sum is white of luminance 1."""
    x, y = primaries.T
    xyz = np.stack([x, y, 1 - x - y])
    return xyz[:, :3] * np.linalg.solve(xyz[:, :3], xyz[:, 3] / y[3])


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
    millions = max(spec.width * spec.height, spec.full_width * spec.full_height) * spec.nchannels / 1e6
    source.close()
    if millions > CHANNELS * most_megapixels:
        raise InputError(
            f"has {spec.width} × {spec.height} pixels of {spec.nchannels} channels, {millions:,.0f} million values",
            file=path,
            key=key,
            cure=f"make it smaller, or leave channels out: at most {CHANNELS * most_megapixels:,.0f} million are read",
        )
