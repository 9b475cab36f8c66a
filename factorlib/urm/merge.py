"""Merging observations of nearly the same normal and view into weighted ones.

Radiance depends on a pixel through its normal and its mirror direction (twice the URM's `half`, less the front).
Pixels of one photo, material and clipping state that fall into one cell of both are replaced by their weighted
mean: normal, view, radiance and confidence alike, so that what is lost is second order in the cell's size.

Radiance is linear in visibility, whose mean is thus what the mean radiance shows.  But on a flat seat all points would
become one, and what their shadows tell of the light be lost: points merge only where what is hidden from them lies
alike, by the mean over the sphere of hidden × direction.
"""

from __future__ import annotations

import msgspec
import numpy as np
from jaxtyping import Float, Int, UInt8
from scipy.sparse import csr_array

from factorlib.geometry.sphere import direction_cells, fibonacci_sphere, mirror_directions
from factorlib.urm.cells import groups
from factorlib.urm.observations import Observations

HIDDEN_CELL = 0.05  # of the mean of hidden × direction, which is 1/4 where a whole hemisphere is hidden
ROWS = 1 << 16  # observations whose visibility is in memory as floats


def merge(observations: Observations, degrees: float) -> Observations:
    """Merge within cells of about `degrees`; 0 merges nothing.  The total weight is kept.

    `x`, `y` and `met` become those of the group's first pixel.
    """
    seen = observations
    if degrees <= 0 or len(seen) == 0:
        return seen
    cell, mirror = np.radians(degrees), mirror_directions(seen.normal, seen.view)
    flags = seen.clipped @ np.array([1, 2, 4])
    cells = [direction_cells(seen.normal, cell), direction_cells(mirror, 2 * cell)]
    if seen.visibility is not None:
        cells.append(_hidden_cells(seen.visibility))
    first, group = groups(np.column_stack([seen.photo, seen.material, flags, *cells]))
    weight = np.maximum(seen.weight.astype(float), 1e-12)
    total = np.bincount(group, weight)

    def mean(values: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "g 3"]:
        """Weighted mean of each group."""
        return np.column_stack([np.bincount(group, weight * v) / total for v in values.T])

    def unit(vectors: Float[np.ndarray, "g 3"]) -> Float[np.ndarray, "g 3"]:
        """The vectors at length 1, float32."""
        return (vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)).astype("f4")

    changed = {"normal": unit(mean(seen.normal)), "view": unit(mean(seen.view))}
    changed |= {"radiance": mean(seen.radiance).astype("f4"), "weight": total.astype("f4")}
    if seen.visibility is not None:
        changed["visibility"] = _mean_visibility(seen.visibility, weight / total[group], group)
    if seen.confidence is not None:
        changed["confidence"] = (np.bincount(group, weight * seen.confidence) / total).astype("f4")
    return msgspec.structs.replace(seen.take(first), **changed)


def _hidden_cells(visibility: UInt8[np.ndarray, "n k"]) -> Int[np.ndarray, "n 3"]:
    """Cells of where the hidden directions lie."""
    mean = fibonacci_sphere(visibility.shape[1]).astype("f4") / visibility.shape[1]
    hidden = [(255 - visibility[i : i + ROWS]).astype("f4") / 255 @ mean for i in range(0, len(visibility), ROWS)]
    return np.rint(np.vstack(hidden) / HIDDEN_CELL).astype(np.int64)


def _mean_visibility(
    visibility: UInt8[np.ndarray, "n k"], share: Float[np.ndarray, " n"], group: Int[np.ndarray, " n"]
) -> UInt8[np.ndarray, "g k"]:
    """Means with weights that sum to 1 in each group."""
    averaging = csr_array((share.astype("f4"), (group, np.arange(len(group)))))
    columns = [averaging @ visibility[:, i : i + 32].astype("f4") for i in range(0, visibility.shape[1], 32)]
    return np.rint(np.clip(np.hstack(columns), 0, 255)).astype("u1")
