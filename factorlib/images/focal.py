"""Focal length in pixels from what a camera wrote into EXIF, or None where that cannot be had.

Two ways, the first that works:
- `FocalLengthIn35mmFilm` f₃₅ by the convention of CIPA DCG-001: the same angle across the diagonal as on 36 × 24 mm
  film, so f_px = f₃₅ / 43.27 mm × the photo's diagonal in pixels (whole millimetres, so about 1 %).
- `FocalLength` × `FocalPlaneXResolution`, scaled from the width the camera wrote (`PixelXDimension`) to this one.

Both hold for the whole frame only.  A crop keeps the tags and changes the angle, by how much nobody wrote down: a
photo whose proportions are no camera's, or not those the camera wrote, has no focal length here.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from factorlib.images.exif import positive

FILM_DIAGONAL = math.hypot(36.0, 24.0)  # mm
FRAMES = (3 / 2, 4 / 3, 16 / 9)  # long side / short side of whole frames
SAME_SHAPE = 0.02  # relative tolerance of proportions: cameras trim some pixels
UNIT_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 1e-3}  # EXIF FocalPlaneResolutionUnit
log = logging.getLogger("factorlib.images")


def focal_px_of_exif(exif: Mapping[str, Any], width: int, height: int, file: str | Path = "") -> float | None:
    """Pixels, for a photo of width × height as stored; `exif` by OpenImageIO's attribute names.

    >>> round(focal_px_of_exif({"Exif:FocalLengthIn35mmFilm": 50}, 6000, 4000), 1)
    8333.3
    >>> focal_px_of_exif({"Exif:FocalLengthIn35mmFilm": 50}, 4000, 4000) is None
    True
    """
    film = positive(exif.get("Exif:FocalLengthIn35mmFilm"))
    focal = film / FILM_DIAGONAL * math.hypot(width, height) if film else _of_focal_plane(exif, width)
    if focal is not None and _is_cropped(exif, width, height):
        log.warning("%s: is a crop of what the camera took, so its EXIF focal length is not used", file)
        return None
    return focal


def _of_focal_plane(exif: Mapping[str, Any], width: int) -> float | None:
    tags = ("FocalLength", "FocalPlaneXResolution", "PixelXDimension")
    focal, density, taken = (positive(exif.get(f"Exif:{tag}")) for tag in tags)
    unit = UNIT_MM.get(exif.get("Exif:FocalPlaneResolutionUnit", 2))
    return focal * density / unit * width / taken if focal and density and taken and unit else None


def _is_cropped(exif: Mapping[str, Any], width: int, height: int) -> bool:
    shape, taken = _proportion(width, height), [positive(exif.get(f"Exif:Pixel{axis}Dimension")) for axis in "XY"]
    if all(taken) and not _same(shape, _proportion(*taken)):
        return True
    return not any(_same(shape, frame) for frame in FRAMES)


def _proportion(a: float | int, b: float | int) -> float:
    return max(a, b) / min(a, b)


def _same(a: float, b: float) -> bool:
    return abs(a / b - 1) <= SAME_SHAPE
