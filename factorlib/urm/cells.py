"""Groups of observations that are alike."""

from __future__ import annotations

import numpy as np
from jaxtyping import Int


def groups(keys: Int[np.ndarray, "n k"]) -> tuple[Int[np.ndarray, " g"], Int[np.ndarray, " n"]]:
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
