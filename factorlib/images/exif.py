"""EXIF data of a photo, under OpenImageIO's names of the tags: exposure and focal length in pixels.

Focal lengths hold for the whole frame only. A crop keeps the tags and changes the field of view, by an amount that is
not recorded.
"""

import logging
import math
import struct
import warnings
from collections.abc import Mapping
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import Any

from PIL import Image
from PIL.ExifTags import IFD

NAMES = {
    0x829A: "ExposureTime",
    0x829D: "FNumber",
    0x8827: "Exif:PhotographicSensitivity",
    0x920A: "Exif:FocalLength",
    0xA002: "Exif:PixelXDimension",
    0xA003: "Exif:PixelYDimension",
    0xA20E: "Exif:FocalPlaneXResolution",
    0xA210: "Exif:FocalPlaneResolutionUnit",
    0xA405: "Exif:FocalLengthIn35mmFilm",
    0xA401: "Exif:CustomRendered",
    0xA40A: "Exif:Sharpness",
}
WHOLE = (0x8827, 0xA002, 0xA003, 0xA210, 0xA401, 0xA405, 0xA40A)  # tags of whole numbers
DNG_VERSION = 0xC612  # tag that every DNG has
ISO_UNSAID = 65535  # value of the tag if the sensitivity does not fit into it
DAMAGED = (OSError, ValueError, SyntaxError, TypeError, KeyError, IndexError, struct.error)  # Pillow on damaged tags
FILM_DIAGONAL = math.hypot(36.0, 24.0)  # mm
FRAMES = (3 / 2, 4 / 3, 16 / 9)  # long side / short side of whole frames
SAME_SHAPE = 0.02  # relative tolerance of proportions: cameras trim some pixels
UNIT_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 1e-3}  # EXIF FocalPlaneResolutionUnit
log = logging.getLogger("factorlib.images")


def load_tags(source: bytes | str | Path | None) -> Image.Exif:
    """Load the tags of a block in HEIF's form ("Exif", two zeros, a TIFF), or of a file that begins as a TIFF does.

    DNG and most raw files begin so. The tags of other or damaged files are empty.
    """
    exif = Image.Exif()
    with (
        suppress(*DAMAGED),
        warnings.catch_warnings(action="ignore"),  # Pillow warns of damaged tags
        nullcontext() if isinstance(source, bytes | None) else Path(source).open("rb") as stream,
    ):
        if stream is not None:
            exif.load_from_fp(stream)
        elif isinstance(source, bytes | None):
            exif.load(source or b"")
        exif.get_ifd(IFD.Interop)  # loads this directory and the one above it before the file is closed
    return exif


def read_exif(source: bytes | str | Path | None) -> dict[str, float | int]:
    """Read the numbers that `load_tags` loads. Missing or damaged ones are left out; `DNG` is True for a DNG."""
    values: dict[str, float | int] = {}
    with suppress(*DAMAGED), warnings.catch_warnings(action="ignore"):
        exif = load_tags(source)
        values |= {"DNG": True} if DNG_VERSION in exif else {}
        tags = exif.get_ifd(IFD.Exif)
        for tag in NAMES.keys() & tags.keys():
            try:
                number = float(tags[tag][0] if isinstance(tags[tag], tuple) else tags[tag])
            except (TypeError, ValueError, IndexError, ZeroDivisionError):
                continue
            if math.isfinite(number):
                values[NAMES[tag]] = round(number) if tag in WHOLE else number
    return values


def exif_exposure(exif: Mapping[str, Any]) -> float | None:
    """Return t · S / N², exposure time (s) times ISO sensitivity over the squared f-number; None if one is missing.

    The values that a camera records of the same light are proportional to it.

    >>> exif_exposure({"ExposureTime": 0.01, "FNumber": 2.0, "Exif:PhotographicSensitivity": 100})
    0.25
    """
    time, aperture, iso = (_positive(exif, n) for n in ("ExposureTime", "FNumber", "Exif:PhotographicSensitivity"))
    if time is None or aperture is None or iso is None or iso == ISO_UNSAID:
        return None
    exposure = time * iso / aperture**2
    return exposure if 0 < exposure < math.inf else None


def exif_focal_px(exif: Mapping[str, Any], width: int, height: int, file: str | Path = "") -> float | None:
    """Return the focal length in pixels of a photo by its EXIF data.

    There are two ways, and the first that works is taken. `FocalLengthIn35mmFilm` f₃₅ has, by the convention of CIPA
    DCG-001, the same angle across the diagonal as on 36 × 24 mm film. So the length is f₃₅ / 43.27 mm × the photo's
    diagonal (whole millimetres, so about 1 %). The other way is `FocalLength` × `FocalPlaneXResolution`, scaled from
    the width that the camera recorded (`PixelXDimension`) to this one.

    Args:
        exif: Tags.
        width: Width of the photo as stored.
        height: Height of the photo as stored.
        file: File to name in a warning.

    Returns:
        The focal length; None if EXIF does not give it, or if the photo is a crop.

    >>> round(exif_focal_px({"Exif:FocalLengthIn35mmFilm": 50}, 6000, 4000), 1)
    8333.3
    >>> exif_focal_px({"Exif:FocalLengthIn35mmFilm": 50}, 4000, 4000) is None
    True
    """
    lens = "FocalLengthIn35mmFilm", "FocalLength", "FocalPlaneXResolution"
    tags = *lens, "PixelXDimension", "PixelYDimension"
    film, focal, density, across, down = (_positive(exif, f"Exif:{tag}") for tag in tags)
    unit = UNIT_MM.get(exif.get("Exif:FocalPlaneResolutionUnit", 2))
    if film:
        focal_px = film / FILM_DIAGONAL * math.hypot(width, height)
    elif focal and density and across and unit:
        focal_px = focal * density / unit * width / across
    else:
        return None
    shape = _proportion(width, height)
    is_uncropped = not (across and down) or abs(shape / _proportion(across, down) - 1) <= SAME_SHAPE
    if not (is_uncropped and any(abs(shape / frame - 1) <= SAME_SHAPE for frame in FRAMES)):
        log.warning("%s: is a crop of what the camera took, so its EXIF focal length is not used", file)
        return None
    return focal_px


def _proportion(a: float, b: float) -> float:
    """Return the ratio of the longer to the shorter side."""
    return max(a, b) / min(a, b)


def _positive(exif: Mapping[str, Any], name: str) -> float | None:
    """Return a tag as a number, None if it is missing or not positive."""
    value = exif.get(name)
    return float(value) if isinstance(value, (int, float)) and math.isfinite(value) and value > 0 else None
