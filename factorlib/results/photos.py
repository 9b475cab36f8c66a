"""photos.json of `masks`: facts about each photo.

`masks` writes the entry of one photo as <photo>.json; photos.json collects them.
"""

from pathlib import Path
from typing import Annotated

import msgspec

from factorlib.jsonfile import read_result

Positive = Annotated[float, msgspec.Meta(gt=0)]
Size = Annotated[int, msgspec.Meta(ge=1)]


class PhotoFacts(msgspec.Struct, frozen=True):
    """Facts about one photo, in pixels of <photo>.exr of `masks`, each of which covers factor² of the photo's.

    Attributes:
        original_size: width and height of the photo itself, as displayed
        focal_px: None if it is unknown
        focal_source: dataset or exif
        exposure: t·S/N² from EXIF, None if it is unknown
        pixels: number of valid pixels by material
        clipped_fraction: share of them clipped in any channel
    """

    width: Size
    height: Size
    factor: Size
    original_size: tuple[Size, Size]
    focal_px: Positive | None = None
    focal_source: str | None = None
    encoding: str = "srgb"
    exposure: float | None = None
    illumination: str = ""
    pixels: dict[str, int] = {}
    clipped_fraction: float = 0.0


def read_photo_facts(path: str | Path) -> PhotoFacts:
    """Read the facts of one photo as `masks` writes them; InputError if the file has another form."""
    return read_result(path, PhotoFacts, "masks")


def read_photos(path: str | Path) -> dict[str, PhotoFacts]:
    """Read photos.json: facts by photo; InputError if the file has another form."""
    return read_result(path, dict[str, PhotoFacts], "masks")
