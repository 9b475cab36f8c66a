"""Limits on the size of a picture, checked by its header before any pixel is read.

A compressed picture of one colour takes a thousandth of its size in memory, so a file of a few megabytes can need all
memory of a machine.
"""

from contextlib import suppress
from math import ceil
from pathlib import Path

import OpenImageIO as oiio

from factorlib.errors import InputError

MOST_MEGAPIXELS = 200.0  # twice the number of the largest sensors
CHANNELS = 4  # greatest number of channels of an ordinary photo


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
    """Check the number of values of an image file against that of a photo with CHANNELS channels.

    A file that is no image, or of a kind that OpenImageIO does not read, passes: its reader rejects it.

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
