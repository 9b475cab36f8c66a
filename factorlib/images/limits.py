"""How large a picture may be: asked of its header, before any pixel is read.

Compressed, a picture of one colour takes a thousandth of what it takes in memory: a file of a few megabytes can stand for all a
machine has.
"""

from contextlib import suppress
from math import ceil
from pathlib import Path

import OpenImageIO as oiio

from factorlib.errors import InputError

MOST_MEGAPIXELS = 200.0  # twice what the largest sensors have
CHANNELS = 4  # of an ordinary photo: so many of each of the most pixels


def check_pixels(size: tuple[int, int], most_megapixels: float, path: str | Path, key: str | None = None) -> None:
    """Raises InputError for more pixels; size: (height, width).

    >>> check_pixels((30_000, 30_000), 200.0, "kitchen.png")
    Traceback (most recent call last):
    factorlib.errors.InputError: kitchen.png: has 30000 × 30000 pixels, 900 megapixels; at most 200 are read
      make photo and masks smaller, or allow it: SET="masks.most_megapixels=900"
    """
    height, width = size
    millions = height * width / 1e6
    if millions > most_megapixels:
        fault = f"has {width} × {height} pixels, {millions:.4g} megapixels; at most {most_megapixels:g} are read"
        cure = f'make photo and masks smaller, or allow it: SET="masks.most_megapixels={ceil(millions)}"'
        raise InputError(fault, file=path, key=key, cure=cure)


def check_values(path: str | Path, most_megapixels: float = MOST_MEGAPIXELS, key: str | None = None) -> None:
    """Raises InputError for an image with more values than a photo of `most_megapixels` has in CHANNELS channels.

    A file that is no image, or of a kind that OpenImageIO does not read, passes: who reads it refuses it.
    """
    source = oiio.ImageInput.open(str(path))
    if source is None:
        with suppress(UnicodeError):  # the words of a damaged file may be damaged themselves
            oiio.geterror()  # read, so that nobody else takes it for their own
        return
    spec = source.spec()
    millions = spec.width * spec.height * spec.nchannels / 1e6
    source.close()
    if millions > CHANNELS * most_megapixels:
        fault = f"has {spec.width} × {spec.height} pixels of {spec.nchannels} channels, {millions:,.0f} million values"
        cure = f"make it smaller, or leave channels out: at most {CHANNELS * most_megapixels:,.0f} million are read"
        raise InputError(fault, file=path, key=key, cure=cure)
