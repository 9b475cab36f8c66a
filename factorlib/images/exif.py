"""What a camera wrote about a photo (EXIF), by OpenImageIO's names of the tags, and how much light its exposure let in."""

from __future__ import annotations

import math
import struct
import warnings
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from pathlib import Path
from typing import Any

from PIL import Image

EXIF_IFD = 0x8769
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
}
WHOLE = (0x8827, 0xA002, 0xA003, 0xA210, 0xA405)
DNG_VERSION = 0xC612  # a tag that every DNG has
ISO_UNSAID = 65535  # what the tag holds for all that does not fit into it
DAMAGED = (OSError, ValueError, SyntaxError, TypeError, KeyError, IndexError, struct.error)  # what Pillow makes of it


def exposure_of_exif(exif: Mapping[str, Any]) -> float | None:
    """t · S / N²: exposure time (s) times ISO sensitivity over the square of the f-number; None where one is not said.

    What a camera writes of the same light is proportional to it.

    >>> exposure_of_exif({"ExposureTime": 0.01, "FNumber": 2.0, "Exif:PhotographicSensitivity": 100})
    0.25
    """
    time, aperture, iso = (
        positive(exif.get(name)) for name in ("ExposureTime", "FNumber", "Exif:PhotographicSensitivity")
    )
    if time is None or aperture is None or iso is None or iso == ISO_UNSAID:
        return None
    exposure = time * iso / aperture**2
    return exposure if 0 < exposure < math.inf else None


def exif_of_bytes(data: bytes | None) -> dict[str, float | int]:
    """The tags of a block as HEIF keeps it ("Exif", two zeros, a TIFF); what is damaged says nothing."""
    return _tags(data or b"", _named)


def exif_of_tiff(path: str | Path) -> dict[str, float | int]:
    """The tags of a file that begins as a TIFF does, as DNG and most raw files do; none of others."""
    return _tags(path, _named)


def is_dng(path: str | Path) -> bool:
    """Whether a file is a TIFF that says it is a DNG."""
    return bool(_tags(path, lambda exif: {DNG_VERSION: True} if DNG_VERSION in exif else {}))


def _tags(source: bytes | str | Path, take: Callable[[Image.Exif], dict]) -> dict:
    """Pillow warns of tags that are damaged, in its own source's lines: such tags say nothing here."""
    exif = Image.Exif()
    try:
        with (
            warnings.catch_warnings(action="ignore"),
            nullcontext() if isinstance(source, bytes) else Path(source).open("rb") as stream,
        ):
            exif.load(source) if stream is None else exif.load_from_fp(stream)
            return take(exif)
    except DAMAGED:
        return {}


def _named(exif: Image.Exif) -> dict[str, float | int]:
    tags = exif.get_ifd(EXIF_IFD)
    numbers = {tag: _number(tags[tag]) for tag in NAMES if tag in tags}
    return {NAMES[tag]: round(value) if tag in WHOLE else value for tag, value in numbers.items() if value is not None}


def _number(value: Any) -> float | None:
    try:
        number = float(value[0] if isinstance(value, tuple) else value)
    except (TypeError, ValueError, IndexError, ZeroDivisionError):
        return None
    return number if math.isfinite(number) else None


def positive(value: Any) -> float | None:
    """The value of a tag as a number, None where it is none, or not more than 0."""
    return float(value) if isinstance(value, (int, float)) and math.isfinite(value) and value > 0 else None
