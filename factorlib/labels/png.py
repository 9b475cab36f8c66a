"""Reader of the stored values of a one-channel PNG: palette indices, not the palette's colours.

Pillow reads it, because it alone keeps the indices. It stretches grey of 2 or 4 bits to 8 bits, which is undone.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, UInt16
from PIL import Image

from factorlib.errors import InputError
from factorlib.reading import check_plain, reading

_STRETCH = {2: 85, 4: 17}  # code of 1 after grey of so many bits is stretched to 8
_GREY = 0  # PNG colour types
_PALETTE = 3
Image.MAX_IMAGE_PIXELS = None  # Pillow warns at 89 megapixels; a mask has the size of its photo, which is limited


def read_values(path: str | Path, key: str, size: tuple[int, int] | None = None) -> UInt16[np.ndarray, "h w"]:
    """Read the stored values of a PNG.

    RGB is accepted only if R = G = B, alpha only if it is opaque.

    Args:
        path: File.
        key: Key to name in errors.
        size: Expected height and width, checked by the header.

    Returns:
        Values.

    Raises:
        InputError: If the file is no such PNG, or has another size.
    """
    check_plain(path, "a PNG", key)
    with reading("a PNG", path, key, "save the mask again, as PNG"), Image.open(path, formats=["PNG"]) as image:
        check_size(image.size[::-1], size or image.size[::-1], path, key)
        values = np.asarray(image)
    with Path(path).open(
        "rb"
    ) as stream:  # bit depth and colour type, after signature, IHDR's length and name, and size
        depth, colour_type = stream.read(26)[24:26]
    fault = None
    if depth == 16 and colour_type not in (_GREY, _PALETTE):  # Pillow keeps only the upper byte
        fault = "has several channels of 16 bits"
        cure = "save labels in one channel of 8 bits"
    elif values.ndim == 3:
        alpha = values[..., -1] if values.shape[-1] in (2, 4) else None
        colours = values if alpha is None else values[..., :-1]
        coloured = (colours != colours[..., :1]).any(axis=-1)
        if coloured.any():
            fault = f"is a colour picture (one pixel is {tuple(colours[coloured][0].tolist())})"
            cure = "save labels in one channel: 0 background, k for the k-th material, 255 leave out"
        elif alpha is not None and (alpha != np.iinfo(alpha.dtype).max).any():
            fault = "has transparent pixels"
            cure = "save it without alpha: 0 is background"
        values = colours[..., 0]
    if fault:
        raise InputError(fault, file=path, key=key, cure=cure)
    return (values // (_STRETCH.get(depth, 1) if colour_type == _GREY else 1)).astype(np.uint16)


def read_inside(path: str | Path, key: str, size: tuple[int, int] | None = None) -> Bool[np.ndarray, "h w"]:
    """Read a mask of one object or material.

    Inside are the values above half of the greatest one, which suits 0/1, 0/255 and soft edges.

    Args:
        path: File.
        key: Key to name in errors.
        size: Expected height and width.

    Returns:
        A mask.
    """
    values = read_values(path, key, size)
    return values * 2 > values.max() if values.any() else np.zeros(values.shape, dtype=bool)


def check_size(size: Sequence[int], expected: Sequence[int], path: str | Path, key: str) -> None:
    """Check a size (height, width) against the photo's; the error says so if the mask is rotated by 90°.

    Args:
        size: Size of the mask.
        expected: Size of the photo.
        path: File to name in the error.
        key: Key to name in the error.

    Raises:
        InputError: If they differ.
    """
    if tuple(size) != tuple(expected):
        cure = "save the mask with the photo's own pixels"
        if tuple(size) == tuple(expected)[::-1]:
            cure = "it lies on its side: the photo's EXIF orientation is applied, so mask the photo as it is displayed"
        raise InputError(
            f"the mask is {size[1]} × {size[0]} pixels, the photo {expected[1]} × {expected[0]}",
            file=path,
            key=key,
            cure=cure,
        )
