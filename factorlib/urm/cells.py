"""Groups of observations that are alike, and cells of directions to tell which are."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int


def groups(keys: Int[np.ndarray, "n k"]) -> tuple[Int[np.ndarray, "g"], Int[np.ndarray, "n"]]:
    """The first row of each group of equal rows, groups in lexicographic order, and each row's group.

    As np.unique of rows, on one number a row.
    """
    code, size = np.zeros(len(keys), np.int64), 1
    for column in keys.T - keys.min(0)[:, None]:
        span = int(column.max()) + 1
        if size * span >= 1 << 62:
            code = np.unique(code, return_inverse=True)[1]
            size = int(code.max()) + 1
        code, size = code * span + column, size * span
    order = np.argsort(code)
    starts = np.flatnonzero(np.diff(code[order], prepend=-1))
    group = np.empty(len(keys), np.int64)
    group[order] = np.repeat(np.arange(len(starts)), np.diff(starts, append=len(keys)))
    return np.minimum.reduceat(order, starts), group


def direction_cells(direction: Float[np.ndarray, "n 3"], size: float) -> Int[np.ndarray, "n 3"]:
    """Cells of roughly `size` radians: an octahedral map of the sphere, cut into squares."""
    x, y, z = np.moveaxis(direction / np.abs(direction).sum(-1, keepdims=True), -1, 0)
    fold = z > 0  # the viewer's side (z < 0) stays whole in the middle
    u = np.where(fold, (1 - np.abs(y)) * np.sign(x), x)
    v = np.where(fold, (1 - np.abs(x)) * np.sign(y), y)
    step = size / np.sqrt(np.pi)  # the square of area 4 covers 4π steradians
    return np.floor(np.column_stack([u, v, fold]) / np.array([step, step, 1.0])).astype(np.int64)
