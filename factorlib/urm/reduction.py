"""Fewer observations with little loss of information: merging of similar ones, and a stratified, weighted sample.

Merging: Radiance depends on a pixel through its normal and its mirror direction (twice the URM's `half`, less the
front). Pixels of one photo, object, material and clipping state that fall into one cell of both are replaced by their
weighted mean. Normal, view, radiance, place, confidence and detail are averaged, so that the error is second order in
the cell's size. Radiance is linear in visibility, so mean visibility belongs to mean radiance. But on a flat seat all
points would merge into one, and the information of their shadows about the light would be lost. So points merge only if
the directions hidden from them are similar, by the mean over the sphere of hidden × direction.

Sampling, which is deterministic: Strata are the materials, their clipping states, and cells of normals. Pixels of one
stratum are nearly redundant, so large strata are thinned first. Each stratum keeps its pixels up to a number that is
the same for all and as large as possible. Most pixels of a flat seat are dropped; the few pixels at the rim of a
highlight are all kept. The selected pixels are spread evenly over their stratum and stand for the others too: weights
are scaled so that the sum of weights of each stratum is preserved.
"""

import msgspec
import numpy as np
from jaxtyping import Int
from scipy.sparse import csr_array

from factorlib.geometry.sphere import direction_cells, fibonacci_sphere, mirror_directions
from factorlib.urm.observations import Observations

DETAIL_CELL = 0.1  # cell of the logarithm of the reflectance detail
HIDDEN_CELL = 0.05  # cell of the mean of hidden × direction, which is 1/4 if a whole hemisphere is hidden
ROWS = 1 << 16  # number of observations whose visibility is in memory as floats
CELL = np.radians(3.0)  # cell of normals, about the accuracy of poses and meshes


def merge(observations: Observations, degrees: float) -> Observations:
    """Merge within cells of about `degrees`; 0 merges nothing. The total weight is preserved.

    `x`, `y` and `occluder` become those of the group's first pixel.
    """
    if degrees <= 0 or len(observations) == 0:
        return observations
    cell = np.radians(degrees)
    mirror = mirror_directions(observations.cell_normal, observations.view)
    flags = observations.clipped @ np.array([1, 2, 4])
    cells = [direction_cells(observations.cell_normal, cell), direction_cells(mirror, 2 * cell)]
    if observations.object is not None:
        cells.append(observations.object[:, None])
    if observations.detail is not None:
        cells.append(np.rint(np.log(np.maximum(observations.detail, 1e-3)) / DETAIL_CELL).astype(np.int64))
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
    for name in ("normal", "view", "radiance", "place", "detail", "given_normal"):
        if (values := getattr(observations, name)) is None:
            continue
        mean = np.column_stack([np.bincount(group, weight * v) / total for v in values.T])
        length = 1 if name in ("radiance", "place", "detail") else np.linalg.norm(mean, axis=-1, keepdims=True)
        changed[name] = (mean / length).astype("f4")
    if visibility is not None:
        averaging = csr_array(((weight / total[group]).astype("f4"), (group, np.arange(len(group)))))
        columns = [averaging @ visibility[:, i : i + 32].astype("f4") for i in range(0, visibility.shape[1], 32)]
        changed["visibility"] = np.rint(np.clip(np.hstack(columns), 0, 255)).astype("u1")
    if observations.confidence is not None:
        changed["confidence"] = (np.bincount(group, weight * observations.confidence) / total).astype("f4")
    return msgspec.structs.replace(observations.take(first), **changed)


def groups(keys: Int[np.ndarray, "n k"]) -> tuple[Int[np.ndarray, " g"], Int[np.ndarray, " n"]]:
    """Group equal rows; give the first row of each group, in lexicographic order of groups, and the group of each row.

    This is np.unique of rows, but faster.
    """
    order = np.lexsort(keys.T[::-1])
    begins = np.r_[True, (np.diff(keys[order], axis=0) != 0).any(axis=1)]
    group = np.empty(len(keys), np.int64)
    group[order] = np.cumsum(begins) - 1
    return order[begins], group


def sample(observations: Observations, most: int) -> Observations:
    """Select at most `most` observations of one photo, in their order; all of them, unchanged, if there are no more."""
    if len(observations) <= most:
        return observations
    group = strata(observations, most)
    rows = select_evenly(group, allot(np.bincount(group), most))
    part = observations.take(rows)
    # scale the weights so that the sum of each stratum is preserved
    share = np.bincount(group, observations.weight) / np.bincount(group[rows], part.weight)
    return msgspec.structs.replace(part, weight=(part.weight * share[group[rows]]).astype(np.float32))


def strata(observations: Observations, most: int) -> Int[np.ndarray, " n"]:
    """Return the stratum of each observation, from 0; cells grow until there are at most `most` strata."""
    kind = np.column_stack([observations.material, observations.clipped @ np.array([1, 2, 4])])
    cell = CELL
    while True:
        normal_cells = (
            direction_cells(observations.normal, cell) if cell < np.pi else np.zeros((len(kind), 0), np.int64)
        )
        first, group = groups(np.column_stack([kind, normal_cells]))
        if len(first) <= most or cell >= np.pi:
            return group
        cell *= 2


def allot(size: Int[np.ndarray, " g"], most: int) -> Int[np.ndarray, " g"]:
    """Return the number of pixels that each stratum keeps: its size, up to a common limit; `most` in all.

    The limit differs by one between some strata, so that the sum is exact.

    >>> allot(np.array([1, 5, 100, 80]), 27).tolist()
    [1, 5, 11, 10]
    """
    ascending = np.sort(size)
    before = np.concatenate([[0], np.cumsum(ascending)[:-1]])
    # by ascending size: the limit for this stratum and all larger ones, if all smaller ones are kept whole
    room = (most - before) // np.arange(len(size), 0, -1)
    cut = np.flatnonzero(room < ascending)
    if not len(cut):
        return size
    count = np.minimum(size, room[cut[0]])
    count[np.flatnonzero(size > count)[: most - count.sum()]] += 1
    return count


def select_evenly(group: Int[np.ndarray, " n"], count: Int[np.ndarray, " g"]) -> Int[np.ndarray, " m"]:
    """Select `count` rows of each group at even steps through its rows; return them in ascending order.

    >>> select_evenly(np.array([0, 1, 0, 0, 0]), np.array([2, 1])).tolist()
    [1, 2, 4]
    """
    # rank of each row in its group; select a row where ⌊rank · count / size⌋ steps up
    order = np.argsort(group, kind="stable")
    size = np.bincount(group, minlength=len(count))
    rank = np.arange(len(group)) - np.repeat(np.cumsum(size) - size, size)
    total = np.repeat(size, size)
    selected = np.repeat(count, size)
    return np.sort(order[(rank + 1) * selected // total > rank * selected // total])
