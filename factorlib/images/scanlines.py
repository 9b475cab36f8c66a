"""Photos that OpenImageIO reads (JPEG, PNG, TIFF, EXR, HDR), by scanlines.

One channel is grey, and repeated; alpha is dropped.  Integer colours are taken as stored, without the alpha multiplied in; float
colours (EXR) are premultiplied by convention and are taken so.
"""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
from jaxtyping import Shaped

from factorlib.errors import InputError
from factorlib.images.stored import Rows, Stored
from factorlib.reading import one_line

WHITE = {oiio.UINT8: 2**8 - 1, oiio.UINT16: 2**16 - 1, oiio.UINT32: 2**32 - 1}
log = logging.getLogger("factorlib.images")


def open_scanlines(path: str | Path, key: str | None) -> Stored:
    """Raises InputError for a file that is no image, or holds no grey or RGB."""
    wish = oiio.ImageSpec()
    wish.attribute("oiio:UnassociatedAlpha", 1)
    source = oiio.ImageInput.open(str(path), wish)
    if source is None:
        found = f"not readable as an image ({one_line(oiio.geterror())})"
        raise InputError(found, file=path, key=key, cure="is it whole, and of the kind its suffix says?")
    spec = source.spec()
    orientation, white = spec.get_int_attribute("Orientation", 1), WHITE.get(spec.format.basetype)
    return Stored(
        width=spec.width,
        height=spec.height,
        orientation=orientation if 1 <= orientation <= 8 else 1,
        exif={a.name: a.value for a in spec.extra_attribs},
        profile=spec.get_string_attribute("ICCProfile:profile_description"),
        white=white,
        encoding="linear" if white is None else "srgb",
        rows=_reader(source, spec, _colours(spec, path, key), path, key),
    )


def _reader(
    source: oiio.ImageInput, spec: oiio.ImageSpec, colours: list[int], path: str | Path, key: str | None
) -> Rows:
    first, picked = min(colours), [c - min(colours) for c in colours]

    def rows(begin: int, end: int) -> Shaped[np.ndarray, "r w 3"]:
        """Rows begin … end − 1."""
        pixels = source.read_scanlines(spec.y + begin, spec.y + end, 0, first, max(colours) + 1, spec.format)
        return _checked(source, pixels, path, key)[..., picked]

    return _of_tiles(source, spec, colours, path, key) if spec.tile_width else rows


def _of_tiles(
    source: oiio.ImageInput, spec: oiio.ImageSpec, colours: list[int], path: str | Path, key: str | None
) -> Rows:
    """A file of tiles has no scanlines: it is in memory as a whole, in its own type."""
    cached: list[np.ndarray] = []

    def rows(begin: int, end: int) -> Shaped[np.ndarray, "r w 3"]:
        """Rows begin … end − 1."""
        if not cached:
            cached.append(_checked(source, source.read_image(spec.format), path, key)[..., colours])
        return cached[0][begin:end]

    return rows


def _checked(source: oiio.ImageInput, pixels: np.ndarray | None, path: str | Path, key: str | None) -> np.ndarray:
    error = source.geterror()
    if pixels is None or "Premature end" in error:
        raise InputError(
            f"truncated or damaged ({one_line(error)})", file=path, key=key, cure="copy it again from where it came"
        )
    if error:
        log.warning("%s: %s", path, one_line(error))
    return pixels


def _colours(spec: oiio.ImageSpec, path: str | Path, key: str | None) -> list[int]:
    """The channels that are red, green and blue; thrice the same where there is only grey."""
    names = list(spec.channelnames)
    if set("RGB") <= set(names):
        return [names.index(name) for name in "RGB"]
    colours = [index for index in range(len(names)) if index != spec.alpha_channel and names[index] != "Z"]
    if len(colours) != 1:
        raise InputError(
            f"has the channels {', '.join(names)}", file=path, key=key, cure="save it as RGB or grey, in one layer"
        )
    return 3 * colours
