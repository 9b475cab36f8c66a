"""Downsampling of pictures by a whole factor f, in which every pixel of the smaller picture is a box of f × f pixels.

A whole factor is exact: each pixel belongs to one box, so a box has one mean, and its pixels have whole votes. Boxes
count from the upper left corner of the displayed picture. The remainder at the right and at the bottom, fewer than f
pixels, is dropped. So all boxes are whole, and a point (x, y) of the photo is exactly (x/f, y/f) of the smaller
picture.
"""

from math import isqrt

import numpy as np
from jaxtyping import Bool, Float, Shaped

VOTED_AT_ONCE = 1 << 21  # number of pixels of a strip


def least_factor(pixels: int, most: int) -> int:
    """Return the least f with pixels / f² ≤ most; 1 for no pixels.

    >>> [least_factor(pixels, 100) for pixels in (0, 100, 101, 400, 401)]
    [1, 1, 2, 2, 3]
    """
    return isqrt(max(-(-pixels // most) - 1, 0)) + 1


def whole_boxes(picture: Shaped[np.ndarray, "h w *c"], factor: int) -> Shaped[np.ndarray, "i f j f *c"]:
    """Return a view of the picture by rows of boxes, rows of a box, columns of boxes and columns of a box.

    The remainder is dropped.
    """
    rows, columns = (n // factor for n in picture.shape[:2])
    inner = picture[: rows * factor, : columns * factor]
    return inner.reshape(rows, factor, columns, factor, *picture.shape[2:])


def box_sum(
    picture: Shaped[np.ndarray, "h w *c"], factor: int, kind: type = np.float64
) -> Shaped[np.ndarray, "i j *c"]:
    """Sum over boxes.

    Args:
        picture: Picture.
        factor: Side of a box.
        kind: Type of the sums.

    Returns:
        A picture of sums.
    """
    return whole_boxes(picture, factor).sum(1, dtype=kind).sum(2, dtype=kind)


def box_mean(
    radiance: Float[np.ndarray, "h w 3"], finite: Bool[np.ndarray, "h w"], factor: int
) -> tuple[Float[np.ndarray, "i j 3"], Bool[np.ndarray, "i j"]]:
    """Average the finite pixels of each box.

    Sums are float64: the mean of equal values is that value.

    Args:
        radiance: Radiance, 0 where it is not finite.
        finite: Mask of finite pixels.
        factor: Side of a box.

    Returns:
        Means, 0 for boxes without a finite pixel, and a mask of the boxes with one.
    """
    count = box_sum(finite, factor, np.int64)
    return (box_sum(radiance, factor) / np.maximum(count, 1)[..., None]).astype(np.float32), count > 0


def box_any(flags: Bool[np.ndarray, "h w *c"], factor: int) -> Bool[np.ndarray, "i j *c"]:
    """Return a mask of the boxes in which any pixel is set."""
    return np.logical_or.reduce(np.logical_or.reduce(whole_boxes(flags, factor), axis=1), axis=2)


def box_majority(values: Shaped[np.ndarray, "h w"], factor: int) -> Shaped[np.ndarray, "i j"]:
    """Return the most frequent value of each box.

    If two values are equally frequent, boxes alternate between the smaller and the larger one like a chessboard. So
    outlines neither grow, nor shrink, nor move.

    >>> box_majority(np.array([[0, 0, 1, 1], [0, 1, 0, 0], [2, 2, 0, 1], [0, 0, 1, 0]]), 2).tolist()
    [[0, 1], [2, 0]]
    """
    if factor == 1:
        return values
    rows, columns = (n // factor for n in values.shape)
    result = np.empty((rows, columns), values.dtype)
    step = max(1, VOTED_AT_ONCE // (factor * values.shape[1]))
    for first in range(0, rows, step):
        last = min(first + step, rows)
        strip = values[first * factor : last * factor]
        candidates = np.unique(strip)  # ascending
        smallest = np.full((last - first, columns), candidates[0])
        largest = smallest.copy()
        most = np.zeros(smallest.shape, np.int64)
        # smallest and largest of the most frequent values of each box
        for value in candidates:
            votes = box_sum(strip == value, factor, np.int64)
            smallest[votes > most] = value
            largest[votes >= most] = value
            most = np.maximum(votes, most)
        odd = np.add.outer(np.arange(first, last), np.arange(columns)) % 2
        result[first:last] = np.where(odd, largest, smallest)
    return result
