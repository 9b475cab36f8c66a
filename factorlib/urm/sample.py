"""Stratified, weighted, deterministic sample of a photo's observations, with little loss of information.

Strata are the materials, their clipping states, and cells of normals. Pixels of one stratum are nearly redundant, so
large strata are thinned first. Each stratum keeps its pixels up to a number that is the same for all and as large as
possible. Most pixels of a flat seat are dropped; the few pixels at the rim of a highlight are all kept.

The selected pixels are spread evenly over their stratum and stand for the others too: weights are scaled so that the
sum of weights of each stratum is preserved.
"""

from __future__ import annotations

import msgspec
import numpy as np
from jaxtyping import Int

from factorlib.geometry.sphere import direction_cells
from factorlib.urm.merge import groups
from factorlib.urm.observations import Observations

CELL = np.radians(3.0)  # cell of normals, about the accuracy of poses and meshes


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
