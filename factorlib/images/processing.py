"""Detection of a phone's processing beyond a tone curve: local tone mapping, and sharpening.

Neither can be undone, because radiance is no longer the same function of the pixel's code everywhere. They are detected
and reported.
"""

from collections.abc import Mapping
from typing import Any

RENDERED = {
    1: "by a process of its own",
    **dict.fromkeys((2, 3, 4), "HDR"),
    6: "panorama",
    7: "portrait, HDR",
    8: "portrait",
}
HARD = 2  # value of EXIF's Sharpness


def reported_processing(exif: Mapping[str, Any]) -> str | None:
    """Return EXIF's description of irreversible processing (CustomRendered, also with Apple's values, and Sharpness).

    It is None if there is none.

    >>> reported_processing({"Exif:CustomRendered": 3}), reported_processing({"Exif:Sharpness": 0})
    ('HDR', None)
    """
    kinds = [
        RENDERED.get(exif.get("Exif:CustomRendered", 0)),
        "sharpened" if exif.get("Exif:Sharpness") == HARD else None,
    ]
    return ", ".join(filter(None, kinds)) or None
