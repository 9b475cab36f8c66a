"""Values of a one-channel PNG as they are stored: palette indices, not the palette's colours.

Pillow, for it alone keeps the indices; grey of 2 or 4 bits, which it stretches to 8, is undone.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, UInt16
from PIL import Image

from factorlib.errors import InputError
from factorlib.reading import check_plain, reading

_STRETCH = {2: 85, 4: 17}  # what 1 becomes when grey of so many bits is stretched to 8
_GREY, _PALETTE = 0, 3  # PNG colour types
Image.MAX_IMAGE_PIXELS = None  # Pillow warns at 89 megapixels; a mask is as large as its photo, whose size has a limit


def read_values(path: str | Path, key: str, size: tuple[int, int] | None = None) -> UInt16[np.ndarray, "h w"]:
    """The stored values of the PNG at `path`.  RGB is read only where R = G = B, alpha only where it is opaque.

    size: (height, width) that it should have; a picture of another size is refused by its header.
    """
    check_plain(path, "a PNG", key)
    with reading("a PNG", path, key, "save the mask again, as PNG"), Image.open(path, formats=["PNG"]) as image:
        check_size(image.size[::-1], size or image.size[::-1], path, key)
        values = np.asarray(image)
    with Path(path).open("rb") as stream:  # after the signature, IHDR's length and name, and the size
        depth, colour_type = stream.read(26)[24:26]
    fault = None
    if depth == 16 and colour_type not in (_GREY, _PALETTE):  # Pillow would keep the upper byte alone
        fault, cure = "has several channels of 16 bits", "save labels in one channel of 8 bits"
    elif values.ndim == 3:
        alpha = values[..., -1] if values.shape[-1] in (2, 4) else None
        colours = values if alpha is None else values[..., :-1]
        coloured = (colours != colours[..., :1]).any(axis=-1)
        if coloured.any():
            fault = f"is a colour picture (one pixel is {tuple(colours[coloured][0].tolist())})"
            cure = "save labels in one channel: 0 background, k for the k-th material, 255 leave out"
        elif alpha is not None and (alpha != np.iinfo(alpha.dtype).max).any():
            fault, cure = "has transparent pixels", "save it without alpha: 0 is background"
        values = colours[..., 0]
    if fault:
        raise InputError(fault, file=path, key=key, cure=cure)
    return (values // (_STRETCH.get(depth, 1) if colour_type == _GREY else 1)).astype(np.uint16)


def read_inside(path: str | Path, key: str, size: tuple[int, int] | None = None) -> Bool[np.ndarray, "h w"]:
    """A mask of one object or material: inside is what lies above half of the greatest value in the file (0/1, 0/255, soft edges)."""
    values = read_values(path, key, size)
    return values * 2 > values.max() if values.any() else np.zeros(values.shape, dtype=bool)


def check_size(size: Sequence[int], expected: Sequence[int], path: str | Path, key: str) -> None:
    """Compare two sizes (height, width); raises InputError unless they are the same, which says so if the mask lies on its side."""
    if tuple(size) != tuple(expected):
        cure = "save the mask with the photo's own pixels"
        if tuple(size) == tuple(expected)[::-1]:
            cure = "it lies on its side: the photo's EXIF orientation is applied, so mask the photo as it is displayed"
        fault = f"the mask is {size[1]} × {size[0]} pixels, the photo {expected[1]} × {expected[0]}"
        raise InputError(fault, file=path, key=key, cure=cure)
