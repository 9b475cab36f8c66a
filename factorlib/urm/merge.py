"""Merging observations of nearly the same normal and view into weighted ones.

Radiance depends on a pixel through its normal and its mirror direction (twice the URM's `half`, less the front).
Pixels of one photo, material and clipping state that fall into one cell of both are replaced by their weighted
mean: normal, view, radiance and confidence alike, so that what is lost is second order in the cell's size.

Radiance is linear in visibility, whose mean is thus what the mean radiance shows.  But on a flat seat all points would
become one, and what their shadows tell of the light be lost: points merge only where what is hidden from them lies
alike, by the mean over the sphere of hidden × direction.
"""

from __future__ import annotations

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
    if degrees <= 0 or len(observations) == 0:
        return observations
    cell = np.radians(degrees)
    mirror = mirror_directions(observations.normal, observations.view)
    flags = observations.clipped @ np.array([1, 2, 4])
    keys = np.column_stack(
        [
            observations.photo,
            observations.material,
            flags,
            direction_cells(observations.normal, cell),
            direction_cells(mirror, 2 * cell),
        ]
    )
    if observations.visibility is not None:
        keys = np.column_stack([keys, _hidden_cells(observations.visibility)])
    return _merged(observations, *groups(keys))


def _hidden_cells(visibility: UInt8[np.ndarray, "n k"]) -> Int[np.ndarray, "n 3"]:
    """Cells of where the hidden directions lie."""
    mean = fibonacci_sphere(visibility.shape[1]).astype("f4") / visibility.shape[1]
    hidden = [(255 - visibility[i : i + ROWS]).astype("f4") / 255 @ mean for i in range(0, len(visibility), ROWS)]
    return np.rint(np.vstack(hidden) / HIDDEN_CELL).astype(np.int64)


def _merged(observations: Observations, first: Int[np.ndarray, " g"], group: Int[np.ndarray, " n"]) -> Observations:
    weight = np.maximum(observations.weight.astype(float), 1e-12)
    total = np.bincount(group, weight)

    def mean(values: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "g 3"]:
        """Weighted mean of each group."""
        return np.column_stack([np.bincount(group, weight * v) / total for v in values.T])

    def unit(vectors: np.ndarray) -> np.ndarray:
        """The vectors at length 1, float32."""
        return (vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)).astype("f4")

    kept = observations.take(first)
    return Observations(
        normal=unit(mean(observations.normal)),
        view=unit(mean(observations.view)),
        radiance=mean(observations.radiance).astype("f4"),
        weight=total.astype("f4"),
        **{name: getattr(kept, name) for name in ("clipped", "material", "photo", "illumination", "x", "y")},
        **{name: getattr(kept, name) for name in ("materials", "photos", "illuminations", "exposures")},
        visibility=None
        if observations.visibility is None
        else _mean_visibility(observations.visibility, weight / total[group], group),
        met=kept.met,
        confidence=None
        if observations.confidence is None
        else (np.bincount(group, weight * observations.confidence) / total).astype("f4"),
    )


def _mean_visibility(
    visibility: UInt8[np.ndarray, "n k"], share: Float[np.ndarray, " n"], group: Int[np.ndarray, " n"]
) -> UInt8[np.ndarray, "g k"]:
    """Means with weights that sum to 1 in each group."""
    averaging = csr_array((share.astype("f4"), (group, np.arange(len(group)))))
    columns = [averaging @ visibility[:, i : i + 32].astype("f4") for i in range(0, visibility.shape[1], 32)]
    return np.rint(np.clip(np.hstack(columns), 0, 255)).astype("u1")
