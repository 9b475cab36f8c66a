"""Merging of observations with nearly the same normal and view into weighted ones.

Radiance depends on a pixel through its normal and its mirror direction (twice the URM's `half`, less the front).
Pixels of one photo, material and clipping state that fall into one cell of both are replaced by their weighted mean.
Normal, view, radiance, place, confidence and detail are averaged, so that the error is second order in the cell's size.

Radiance is linear in visibility, so mean visibility belongs to mean radiance. But on a flat seat all points would merge
into one, and the information of their shadows about the light would be lost. So points merge only if the directions
hidden from them are similar, by the mean over the sphere of hidden × direction.
"""

from __future__ import annotations

import msgspec
import numpy as np
from jaxtyping import Int
from scipy.sparse import csr_array

from factorlib.geometry.sphere import direction_cells, fibonacci_sphere, mirror_directions
from factorlib.urm.observations import Observations

DETAIL_CELL = 0.1  # cell of the logarithm of the reflectance detail
HIDDEN_CELL = 0.05  # cell of the mean of hidden × direction, which is 1/4 if a whole hemisphere is hidden
ROWS = 1 << 16  # number of observations whose visibility is in memory as floats


def merge(observations: Observations, degrees: float) -> Observations:
    """Merge within cells of about `degrees`; 0 merges nothing. The total weight is preserved.

    `x`, `y` and `met` become those of the group's first pixel.
    """
    if degrees <= 0 or len(observations) == 0:
        return observations
    cell = np.radians(degrees)
    mirror = mirror_directions(observations.normal, observations.view)
    flags = observations.clipped @ np.array([1, 2, 4])
    cells = [direction_cells(observations.normal, cell), direction_cells(mirror, 2 * cell)]
    if observations.detail is not None:
        cells.append(np.rint(np.log(np.maximum(observations.detail, 1e-3)) / DETAIL_CELL).astype(np.int64)[:, None])
    if (visibility := observations.visibility) is not None:  # mean of hidden × direction
        directions = fibonacci_sphere(visibility.shape[1]).astype("f4") / visibility.shape[1]
        chunks = (visibility[i : i + ROWS] for i in range(0, len(visibility), ROWS))
        hidden = [(255 - chunk).astype("f4") / 255 @ directions for chunk in chunks]
        cells.append(np.rint(np.vstack(hidden) / HIDDEN_CELL).astype(np.int64))
    first, group = groups(np.column_stack([observations.photo, observations.material, flags, *cells]))
    # weighted mean of each column over each group
    weight = np.maximum(observations.weight.astype(float), 1e-12)
    total = np.bincount(group, weight)

    changed = {"weight": total.astype("f4")}
    for name in ("normal", "view", "radiance", "place"):
        if (values := getattr(observations, name)) is None:
            continue
        mean = np.column_stack([np.bincount(group, weight * v) / total for v in values.T])
        length = 1 if name in ("radiance", "place") else np.linalg.norm(mean, axis=-1, keepdims=True)
        changed[name] = (mean / length).astype("f4")
    if visibility is not None:
        averaging = csr_array(((weight / total[group]).astype("f4"), (group, np.arange(len(group)))))
        columns = [averaging @ visibility[:, i : i + 32].astype("f4") for i in range(0, visibility.shape[1], 32)]
        changed["visibility"] = np.rint(np.clip(np.hstack(columns), 0, 255)).astype("u1")
    for name in ("confidence", "detail"):
        if (values := getattr(observations, name)) is not None:
            changed[name] = (np.bincount(group, weight * values) / total).astype("f4")
    return msgspec.structs.replace(observations.take(first), **changed)


def groups(keys: Int[np.ndarray, "n k"]) -> tuple[Int[np.ndarray, " g"], Int[np.ndarray, " n"]]:
    """Group equal rows; give the first row of each group, in lexicographic order of groups, and the group of each row.

    This is np.unique of rows, on one number a row.
    """
    # encode each row as one integer in mixed radix; compress the codes before they overflow
    code = np.zeros(len(keys), np.int64)
    size = 1
    for column in keys.T - keys.min(0)[:, None]:
        span = int(column.max()) + 1
        if size * span >= 1 << 62:
            code = np.unique(code, return_inverse=True)[1]
            size = int(code.max()) + 1
        code = code * span + column
        size = size * span
    order = np.argsort(code)
    starts = np.flatnonzero(np.diff(code[order], prepend=-1))
    group = np.empty(len(keys), np.int64)
    group[order] = np.repeat(np.arange(len(starts)), np.diff(starts, append=len(keys)))
    return np.minimum.reduceat(order, starts), group
