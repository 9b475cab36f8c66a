"""A photo's pixels as its file stores them: an open file, of which some rows are read at a time.

A camera's 48 megapixels are 576 MB as floating-point radiance.  So a file is opened first, which tells its size, and its rows
are read in order, as many at once as one likes.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np
from jaxtyping import Bool, Shaped

CLIPPED = 0.995  # of the white code: JPEG compression ripples the top code a little
Rows = Callable[[int, int], Shaped[np.ndarray, "r w 3"]]


class Stored(msgspec.Struct, frozen=True):
    """An open photo.

    width, height  as stored
    orientation    EXIF's, of the stored pixels: 1 as they are displayed, 2-4 mirrored or half turned, 5-8 lying on a side
    exif           what the camera wrote, by OpenImageIO's names
    profile        name of the colour profile, "" for none
    white          the code of 1.0; None where the pixels are floats
    encoding       what this kind of file implies
    rows           (begin, end) -> those rows, which are asked for in order, each at most once
    saturated      (begin, end) -> where those rows hold less than there was to see; None: where codes are near white
    """

    width: int
    height: int
    orientation: int
    exif: dict[str, Any]
    profile: str
    white: int | None
    encoding: str
    rows: Rows
    saturated: Callable[[int, int], Bool[np.ndarray, "r w 3"]] | None = None

    @property
    def size(self) -> tuple[int, int]:
        """(height, width) as displayed."""
        return (self.width, self.height) if self.orientation >= 5 else (self.height, self.width)

    def clipped(self, begin: int, end: int, codes: Shaped[np.ndarray, "r w 3"]) -> Bool[np.ndarray, "r w 3"]:
        """Where rows that were read as `codes` hold less than there was to see."""
        if self.saturated is not None:
            return self.saturated(begin, end)
        return np.zeros(codes.shape, bool) if self.white is None else codes >= CLIPPED * self.white
