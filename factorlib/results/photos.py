"""photos.json of `masks`: what is known of each photo.  `masks` writes the entry of one as <photo>.json; photos.json gathers those."""

from pathlib import Path
from typing import Annotated

import msgspec

from factorlib.jsonfile import read_result

Positive = Annotated[float, msgspec.Meta(gt=0)]
Size = Annotated[int, msgspec.Meta(ge=1)]


class PhotoFacts(msgspec.Struct, frozen=True):
    """Pixels are those of masks' <photo>.exr, each of which stands for factor² of the photo's.

    original_size     width and height of the photo itself, as displayed
    focal_px          None where nothing is known of it;  focal_source: dataset or exif
    exposure          t·S/N² from EXIF, None where unknown
    pixels            the valid ones of each material;  clipped_fraction: the share of them clipped in any channel
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
    """The entry of one photo; raises InputError for a file that is none."""
    return read_result(path, PhotoFacts, "masks")


def read_photos(path: str | Path) -> dict[str, PhotoFacts]:
    """All entries, by photo; raises InputError for a file that is none."""
    return read_result(path, dict[str, PhotoFacts], "masks")
