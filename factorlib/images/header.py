"""How much an image takes in memory once it is read: asked of its header.

Compressed, a picture of one colour takes a thousandth of that, and a file of a few megabytes can stand for all a machine has.
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import OpenImageIO as oiio

from factorlib.errors import InputError

CHANNELS = 4  # of an ordinary photo: so many of each of the most pixels


def check_values(path: str | Path, most_megapixels: float, key: str | None = None) -> None:
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
        found = f"has {spec.width} × {spec.height} pixels of {spec.nchannels} channels, {millions:,.0f} million values"
        cure = f"make it smaller, or leave channels out: at most {CHANNELS * most_megapixels:,.0f} million are read"
        raise InputError(found, file=path, key=key, cure=cure)
