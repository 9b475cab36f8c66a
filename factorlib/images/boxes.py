"""Averaging pictures down by a whole factor f: every pixel of the smaller picture stands for a box of f × f pixels.

A whole factor is exact: each pixel lies in one box, so a box has one mean, and its pixels have whole votes.  Boxes count from
the displayed picture's upper left corner.  What is left over at the right and at the bottom, less than f pixels, is dropped, so
that all boxes are whole and a place (x, y) of the photo is (x/f, y/f) of the smaller picture, to the last digit.
"""

from math import isqrt

import numpy as np
from jaxtyping import Bool, Float, Shaped

VOTED_AT_ONCE = 1 << 21  # pixels of a strip


def least_factor(pixels: int, most: int) -> int:
    """The least f for which pixels / f² ≤ most; 1 for none.

    >>> [least_factor(pixels, 100) for pixels in (0, 100, 101, 400, 401)]
    [1, 1, 2, 2, 3]
    """
    return isqrt(max(-(-pixels // most) - 1, 0)) + 1


def whole_boxes(picture: Shaped[np.ndarray, "h w *c"], factor: int) -> Shaped[np.ndarray, "i f j f *c"]:
    """A view of the picture by rows of boxes, rows of a box, columns of boxes, columns of a box, without what is left over."""
    rows, columns = (n // factor for n in picture.shape[:2])
    inner = picture[: rows * factor, : columns * factor]
    return inner.reshape(rows, factor, columns, factor, *picture.shape[2:])


def box_sum(
    picture: Shaped[np.ndarray, "h w *c"], factor: int, kind: type = np.float64
) -> Shaped[np.ndarray, "i j *c"]:
    """Sums over boxes, in the type `kind`."""
    return whole_boxes(picture, factor).sum(1, dtype=kind).sum(2, dtype=kind)


def box_mean(
    radiance: Float[np.ndarray, "h w 3"], finite: Bool[np.ndarray, "h w"], factor: int
) -> tuple[Float[np.ndarray, "i j 3"], Bool[np.ndarray, "i j"]]:
    """Means over the pixels of each box that are finite, and where there are any; 0 where there are none.

    radiance: 0 where not finite.  Sums are float64: the mean of equal values is that value.
    """
    count = box_sum(finite, factor, np.int64)
    return (box_sum(radiance, factor) / np.maximum(count, 1)[..., None]).astype(np.float32), count > 0


def box_any(flags: Bool[np.ndarray, "h w *c"], factor: int) -> Bool[np.ndarray, "i j *c"]:
    """Where any pixel of a box is set."""
    return whole_boxes(flags, factor).any(1).any(2)


def box_majority(values: Shaped[np.ndarray, "h w"], factor: int) -> Shaped[np.ndarray, "i j"]:
    """The value that most pixels of each box have.

    Where two have it equally often, the smaller one is taken in every other box, as on a chessboard, and the larger one in the
    others: outlines neither grow, nor shrink, nor move.

    >>> box_majority(np.array([[0, 0, 1, 1], [0, 1, 0, 0], [2, 2, 0, 1], [0, 0, 1, 0]]), 2).tolist()
    [[0, 1], [2, 0]]
    """
    if factor == 1:
        return values
    rows, columns = (n // factor for n in values.shape)
    result, step = np.empty((rows, columns), values.dtype), max(1, VOTED_AT_ONCE // (factor * values.shape[1]))
    for first in range(0, rows, step):
        last = min(first + step, rows)
        strip = values[first * factor : last * factor]
        candidates = np.unique(strip)  # ascending
        smallest = np.full((last - first, columns), candidates[0])
        largest, most = smallest.copy(), np.zeros(smallest.shape, np.int64)
        for value in candidates:
            votes = box_sum(strip == value, factor, np.int64)
            smallest[votes > most] = value
            largest[votes >= most] = value
            most = np.maximum(votes, most)
        odd = np.add.outer(np.arange(first, last), np.arange(columns)) % 2
        result[first:last] = np.where(odd, largest, smallest)
    return result
