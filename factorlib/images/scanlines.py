"""Open photos, of which some rows are read at a time, and a reader of those that OpenImageIO reads.

A camera's 48 megapixels are 576 MB as floating-point radiance. So a file is opened first, which gives its size, and its
rows are read in order, in chunks of any height. The size is checked before any pixel is read: a compressed picture of
one colour takes a thousandth of its size in memory, so a file of a few megabytes can need all memory of a machine.

For the formats of OpenImageIO (JPEG, PNG, TIFF, EXR, HDR), one channel is grey, and repeated; alpha is dropped. Integer
colours are taken as opened, not premultiplied by alpha; float colours (EXR) are premultiplied by convention. White of
float colours keeps its chromaticity. An EXR has the size of its display window. Of a JPEG with a gain map (Ultra HDR),
the picture that other programs show is read; Pillow decodes it, since OpenImageIO would apply the map.
"""

import logging
import re
import zlib
from collections.abc import Callable
from contextlib import suppress
from functools import cache, partial
from math import ceil
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import OpenImageIO as oiio
from jaxtyping import Bool, Shaped
from PIL import Image

from factorlib.errors import InputError
from factorlib.images.colour_space import LINEAR, SRGB, ColourSpace, colour_space, to_rec709
from factorlib.images.exif import DAMAGED
from factorlib.reading import one_line, reading

CLIPPED = 0.995  # least share of the white code that is clipped: JPEG compression disturbs the top code a little
WHITE = {oiio.UINT8: 2**8 - 1, oiio.UINT16: 2**16 - 1, oiio.UINT32: 2**32 - 1}
BEAUTY = ("beauty", "rgba", "rgb", "combined", "main")  # names that renderers give to the layer that is the picture
SAME_ASPECT = 0.01  # tolerance of a pixel's width over its height
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
    white          code of 1.0; None if the pixels are floats
    space          meaning of the codes
    rows           (begin, end) -> those rows, which are requested in order, each at most once
    saturated      (begin, end) -> mask of saturated values in those rows; None: values with codes near white
    unpack         checks what the file stores, without decoding it; None: the first and last row tell enough
    """

    width: int
    height: int
    orientation: int = 1
    exif: dict[str, Any]
    white: int | None
    space: ColourSpace
    rows: Rows
    saturated: Callable[[int, int], Bool[np.ndarray, "r w 3"]] | None = None
    unpack: Callable[[], object] | None = None

    @property
    def size(self) -> tuple[int, int]:
        """Height and width as displayed."""
        return (self.width, self.height) if self.orientation >= 5 else (self.height, self.width)

    def check_pixels(self, path: str | Path, key: str | None = None) -> None:
        """Read the first and the last row; check the chunks of a PNG, and unpack a raw photo.

        Args:
            path: File to name in the error.
            key: Key to name in the error.

        Raises:
            InputError: If the file is truncated or damaged.
        """
        with reading("an image", path, key):
            if self.unpack is not None:
                self.unpack()
            else:
                self.rows(0, 1)
                self.rows(self.height - 1, self.height)

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
    with Path(path).open("rb") as stream:
        head = stream.read(4096)  # the header, if it is a Radiance file
    source = oiio.ImageInput.open(str(path), config)
    if source is None:
        words = one_line(oiio.geterror())
        if b"FORMAT=32-bit_rle_xyze" in head:
            raise InputError(
                "is a Radiance picture of XYZE, which is not read",
                file=path,
                key=key,
                cure=f"convert it to RGBE: ra_xyze -r {Path(path).name} out.hdr",
            )
        raise InputError(
            f"not readable as an image ({words})",
            file=path,
            key=key,
            cure="the file is damaged or has a wrong suffix: copy or export it again",
        )
    spec, colours = _picture(source, path, key)
    _check_kind(spec, path, key)
    orientation = spec.get_int_attribute("Orientation", 1)
    attributes = {a.name: a.value for a in spec.extra_attribs}
    white = WHITE.get(spec.format.basetype)
    size = (spec.height, spec.width) if white else (spec.full_height, spec.full_width)
    rows = _stored_rows(source, spec, colours, path, key)
    if white is None and source.format_name() == "jpeg":
        rows = _base_rows(path)
        white = 2**8 - 1
    elif white is None:
        rows = _in_display_window(rows, spec)
    is_scene = source.format_name() in ("openexr", "hdr")
    space = (
        _scene_space(spec, head, path) if is_scene else colour_space(path, attributes, SRGB if white else LINEAR, key)
    )
    return OpenPhoto(
        width=size[1],
        height=size[0],
        orientation=orientation if 1 <= orientation <= 8 else 1,
        exif=attributes,
        white=white,
        space=space,
        rows=rows,
        unpack=partial(_check_chunks, path, key) if source.format_name() == "png" else None,
    )


def _check_chunks(path: str | Path, key: str | None) -> None:
    """Check the checksums of a PNG's chunks, a hundredth of the time that its last row takes; else InputError."""
    try:
        with Image.open(path, formats=["PNG"]) as image:
            image.verify()
    except (*DAMAGED, zlib.error) as error:
        raise InputError(f"truncated or damaged ({one_line(str(error))})", file=path, key=key, cure=COPY) from None


def _stored_rows(
    source: oiio.ImageInput, spec: oiio.ImageSpec, colours: list[int], path: str | Path, key: str | None
) -> Rows:
    """Return the reader of rows as stored; from a tiled file, the rows of tiles that contain them are read."""
    first = min(colours)
    last = max(colours) + 1

    def rows(begin: int, end: int) -> Shaped[np.ndarray, "r w 3"]:
        """Read rows begin … end − 1."""
        if tall := spec.tile_height:
            top = begin // tall * tall
            bottom = min(-(-end // tall) * tall, spec.height)
            box = (spec.x, spec.x + spec.width, spec.y + top, spec.y + bottom, spec.z, spec.z + 1)
            pixels = source.read_tiles(*box, first, last, spec.format)
        else:
            top = begin
            pixels = source.read_scanlines(spec.y + begin, spec.y + end, 0, first, last, spec.format)
        error = source.geterror()
        if pixels is None or "premature end" in error.lower():
            old_runs = "; if it has the run lengths of Radiance before 1991, convert it: ra_xyze -r in.hdr out.hdr"
            cure = COPY + old_runs * (source.format_name() == "hdr")
            raise InputError(f"truncated or damaged ({one_line(error)})", file=path, key=key, cure=cure)
        if error:
            log.warning("%s: %s", path, one_line(error))
        return pixels.reshape(-1, spec.width, last - first)[begin - top : end - top, :, np.subtract(colours, first)]

    return rows


def _picture(source: oiio.ImageInput, path: str | Path, key: str | None) -> tuple[oiio.ImageSpec, list[int]]:
    """Open the part of a file that is the picture, and return its header and the indices of red, green and blue.

    Parts (of an EXR, or pages of a TIFF) and layers (`layer.R`) that have colours are candidates; grey ones, if none
    has. The unnamed layer of a file of one part is the picture, else the one with a name of BEAUTY, else the largest.
    """
    specs = [source.spec()]
    while source.format_name() in ("openexr", "tiff") and source.seek_subimage(len(specs), 0):
        specs.append(source.spec())
    parts = [
        (part, layer or spec.get_string_attribute("oiio:subimagename"), spec, colours)
        for part, spec in enumerate(specs)
        for layer, colours in _layers(spec).items()
    ]
    candidates = [each for each in parts if len(set(each[3])) == 3] or [each for each in parts if each[3]]
    if not candidates:
        raise InputError(
            f"has the channels {', '.join(specs[0].channelnames)}: neither grey nor RGB",
            file=path,
            key=key,
            cure="save it as RGB or grey, in one layer",
        )
    largest = max(spec.width * spec.height for _, _, spec, _ in candidates)
    for choice in (
        candidates,
        [each for each in candidates if not each[1] and len(specs) == 1],
        [each for each in candidates if each[1].rpartition(".")[2].lower() in BEAUTY],
        [each for each in candidates if each[2].width * each[2].height == largest],
    ):
        if len(choice) == 1:
            source.seek_subimage(choice[0][0], 0)
            source.geterror()  # of the page after the last
            return choice[0][2:]
    names = ", ".join(name or f"page {part + 1}" for part, name, _, _ in candidates)
    raise InputError(
        f"has {len(candidates)} pictures, and which one is the photo is not clear: {names}",
        file=path,
        key=key,
        cure="save that one as a file of its own, or call its layer 'beauty'",
    )


def _layers(spec: oiio.ImageSpec) -> dict[str, list[int]]:
    """Return the indices of red, green and blue by layer, equal for a picture of one grey channel, [] for others."""
    names = list(spec.channelnames)
    layers = dict.fromkeys(name.rpartition(".")[0] for name in names if name.rpartition(".")[2] in ("R", "G", "B"))
    found = {
        layer: [names.index(name) for name in colours]
        for layer in layers
        if set(colours := [f"{layer}.{c}".lstrip(".") for c in "RGB"]) <= set(names)
    }
    grey = [index for index, name in enumerate(names) if index != spec.alpha_channel and name != "Z"]
    return found or {"": 3 * grey if len(grey) == 1 else []}


def _check_kind(spec: oiio.ImageSpec, path: str | Path, key: str | None) -> None:
    """Check that codes and pixels are of a kind that is read; InputError names another one."""
    colours = spec.get_string_attribute("tiff:ColorSpace") or spec.get_string_attribute("jpeg:ColorSpace")
    aspect = spec.get_float_attribute("PixelAspectRatio", 1.0)
    faults = {
        "it has deep samples": spec.deep,
        f"its codes are of type {spec.format}": spec.format.basetype
        not in (*WHITE, oiio.HALF, oiio.FLOAT, oiio.DOUBLE),
        f"its colours are {colours}": colours not in ("", "RGB", "YCbCr", "palette"),  # converted to RGB exactly
        f"its pixels are not square, but of aspect {aspect:.3g}": abs(aspect - 1) > SAME_ASPECT,
    }
    if fault := next((fault for fault, is_true in faults.items() if is_true), None):
        raise InputError(
            f"not readable as a photo: {fault}",
            file=path,
            key=key,
            cure="save it as RGB of 8 or 16 bits, flat, in square pixels",
        )


def _base_rows(path: str | Path) -> Rows:
    """Return the reader of rows of a JPEG's picture without its gain map; the picture is decoded once, as a whole."""

    @cache
    def base() -> Shaped[np.ndarray, "h w 3"]:
        """Decode the picture."""
        with Image.open(path) as image:
            return np.asarray(image.convert("RGB"))

    return lambda begin, end: base()[begin:end]


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


def _scene_space(spec: oiio.ImageSpec, head: bytes, path: str | Path) -> ColourSpace:
    """Return the linear space of EXR's attribute `chromaticities` or Radiance's line PRIMARIES, else of Rec. 709."""
    line = re.match(rb"#\?[\S\s]*?\nPRIMARIES=([^\n]*)\n", head)
    given = spec.getattribute("chromaticities") or (line[1].split() if line else [0.0] * 8)
    with reading("eight chromaticities of primaries", path, cure="write it again without them"):
        return ColourSpace(LINEAR.curves, to_rec709(np.array(given, float).reshape(4, 2), adapted=False))


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
