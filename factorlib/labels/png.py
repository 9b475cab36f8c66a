"""Values of a one-channel PNG as they are stored: palette indices, not the palette's colours.

Pillow, for it alone keeps the indices; grey of 2 or 4 bits, which it stretches to 8, is undone.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, UInt16
from PIL import Image

from factorlib.errors import InputError
from factorlib.reading import check_plain, reading

_STRETCH = {2: 85, 4: 17}  # what 1 becomes when grey of so many bits is stretched to 8
_GREY, _PALETTE = 0, 3  # PNG colour types
Image.MAX_IMAGE_PIXELS = (
    None  # Pillow warns at 89 megapixels; here a mask is as large as its photo, whose size has its own limit
)


def read_values(path: str | Path, key: str, size: tuple[int, int] | None = None) -> UInt16[np.ndarray, "h w"]:
    """The stored values of the PNG at `path`.  RGB is read only where R = G = B, alpha only where it is opaque.

    size: (height, width) that it should have; a picture of another size is refused by its header.
    """
    check_plain(path, "a PNG", key)
    with reading("a PNG", path, key, "save the mask again, as PNG"), Image.open(path, formats=["PNG"]) as image:
        check_size(image.size[::-1], size or image.size[::-1], path, key)
        values = np.asarray(image)
    depth, colour_type = _depth_and_type(path)
    if depth == 16 and colour_type not in (_GREY, _PALETTE):  # Pillow would keep the upper byte alone
        found = "has several channels of 16 bits"
        raise InputError(found, file=path, key=key, cure="save labels in one channel of 8 bits")
    if values.ndim == 3:
        values = _one_channel(values, path, key)
    return (values // (_STRETCH.get(depth, 1) if colour_type == _GREY else 1)).astype(np.uint16)


def read_inside(path: str | Path, key: str, size: tuple[int, int] | None = None) -> Bool[np.ndarray, "h w"]:
    """A mask of one object or material: inside is what lies above half of the greatest value in the file (0/1, 0/255, soft edges)."""
    values = read_values(path, key, size)
    return values * 2 > values.max() if values.any() else np.zeros(values.shape, dtype=bool)


def check_size(found: Sequence[int], size: Sequence[int], path: str | Path, key: str) -> None:
    """Both (height, width); InputError unless they are the same, which says so if the mask lies on its side."""
    if tuple(found) == tuple(size):
        return
    cure = "save the mask with the photo's own pixels"
    if tuple(found) == tuple(size)[::-1]:
        cure = "it lies on its side: the photo's EXIF orientation is applied, so mask the photo as it is displayed"
    message = f"the mask is {found[1]} × {found[0]} pixels, the photo {size[1]} × {size[0]}"
    raise InputError(message, file=path, key=key, cure=cure)


def _one_channel(values: np.ndarray, path: str | Path, key: str) -> np.ndarray:
    colours, alpha = (values[..., :-1], values[..., -1]) if values.shape[-1] in (2, 4) else (values, None)
    if (colours != colours[..., :1]).any():
        colour = colours.reshape(-1, 3)[(colours != colours[..., :1]).any(axis=-1).ravel()][0]
        fault = f"is a colour picture (one pixel is {tuple(int(c) for c in colour)})"
        cure = "save labels in one channel: 0 background, k for the k-th material, 255 leave out"
        raise InputError(fault, file=path, key=key, cure=cure)
    if alpha is not None and (alpha != np.iinfo(alpha.dtype).max).any():
        raise InputError("has transparent pixels", file=path, key=key, cure="save it without alpha: 0 is background")
    return colours[..., 0]


def _depth_and_type(path: str | Path) -> tuple[int, int]:
    """Bits per sample and colour type: bytes 24 and 25, after the signature, IHDR's length and name, and the size."""
    with Path(path).open("rb") as stream:
        return tuple(stream.read(26)[24:26])
