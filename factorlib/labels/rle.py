"""Run lengths of masks, as COCO has them: of outside, inside, outside, … down the columns.

What is drawn of several is their union; its cost is the number of runs, however many masks they are of, and one picture.
"""

from __future__ import annotations

from itertools import accumulate

import numpy as np
from jaxtyping import Bool

MOST_BITS = 60  # of a run length: no picture has as many pixels


class Union:
    """The union of masks of height × width pixels, each given by its runs."""

    def __init__(self, height: int, width: int):
        self.shape = height, width
        self._edges = np.zeros(height * width + 1, np.int32)  # how many masks begin at a pixel, less how many end

    def add(self, counts: list[int] | str) -> None:
        """Raises ValueError unless the runs fill the picture exactly."""
        runs = decompress(counts) if isinstance(counts, str) else counts
        height, width = self.shape
        if min(runs, default=0) < 0 or sum(runs) != height * width:
            raise ValueError(f"its runs do not fill {height * width} pixels")
        borders = np.cumsum(np.array(runs, np.int64))
        np.add.at(self._edges, borders[0::2], 1)
        np.add.at(self._edges, borders[1::2], -1)

    def mask(self) -> Bool[np.ndarray, "height width"]:
        """The union as a mask."""
        inside = np.cumsum(self._edges[:-1], dtype=np.int32) > 0
        return np.ascontiguousarray(inside.reshape(self.shape[::-1]).T)


def decode_rle(counts: list[int] | str, height: int, width: int) -> Bool[np.ndarray, "height width"]:
    """The mask of run lengths, column by column; raises ValueError unless they fill it exactly.

    >>> decode_rle([1, 2, 1], 2, 2).astype(int).tolist()
    [[0, 1], [1, 0]]
    """
    union = Union(height, width)
    union.add(counts)
    return union.mask()


def decompress(text: str) -> list[int]:
    """Run lengths of COCO's string: 5 bits a character (+48), the sixth says "more follows", the sign in the last;
    from the third run on each is the difference to the run two before.  Raises ValueError."""
    values, value, shift = [], 0, 0
    for character in text:
        bits = ord(character) - 48
        if not 0 <= bits < 64:
            raise ValueError(f"{character!r} is no character of a compressed RLE")
        value |= (bits & 31) << shift
        shift += 5
        if shift > MOST_BITS:
            raise ValueError("a run of its compressed RLE is longer than any picture")
        if not bits & 32:
            values.append(value - (1 << shift) if bits & 16 else value)
            value, shift = 0, 0
    if shift:
        raise ValueError("its compressed RLE ends in the middle of a number")
    return values[:1] + _undifferenced(values[1::2], values[2::2])


def _undifferenced(odd: list[int], even: list[int]) -> list[int]:
    runs = [0] * (len(odd) + len(even))
    runs[0::2], runs[1::2] = accumulate(odd), accumulate(even)
    return runs
