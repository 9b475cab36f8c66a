"""A sample of a photo's observations that tells as much of its materials and light: stratified, weighted, without chance.

Strata are the materials, what is clipped of them, and cells of their normals.  Pixels of one stratum show much the same, so
that large strata are thinned first: each keeps what it has, up to a number that is the same for all and as large as fits.  What
is left over of a flat seat is worth little; the few pixels at the rim of a highlight are all kept.

Those that are kept are spread evenly over their stratum's pixels and stand for the others too: weights grow, so that the weights
of each stratum have the sum that they had.
"""

from __future__ import annotations

import msgspec
import numpy as np
from jaxtyping import Int

from factorlib.geometry.sphere import direction_cells
from factorlib.urm.merge import groups
from factorlib.urm.observations import Observations

CELL = np.radians(3.0)  # of normals: about as well as poses and meshes are known


def sample(observations: Observations, most: int) -> Observations:
    """Return at most `most` observations of one photo, in their order; all of them, unchanged, where there are no more."""
    if len(observations) <= most:
        return observations
    group = strata(observations, most)
    kept = evenly_spread(group, shared_out(np.bincount(group), most))
    part = observations.take(kept)
    share = np.bincount(group, observations.weight) / np.bincount(group[kept], part.weight)
    return msgspec.structs.replace(part, weight=(part.weight * share[group[kept]]).astype(np.float32))


def strata(observations: Observations, most: int) -> Int[np.ndarray, " n"]:
    """The stratum of each observation, from 0; cells grow until there are no more strata than `most`."""
    kind, cell = np.column_stack([observations.material, observations.clipped @ np.array([1, 2, 4])]), CELL
    while True:
        of_normal = direction_cells(observations.normal, cell) if cell < np.pi else np.zeros((len(kind), 0), np.int64)
        first, group = groups(np.column_stack([kind, of_normal]))
        if len(first) <= most or cell >= np.pi:
            return group
        cell *= 2


def shared_out(size: Int[np.ndarray, " g"], most: int) -> Int[np.ndarray, " g"]:
    """Return how many each stratum keeps: what it has, up to a number that is the same for all but for one; `most` in all.

    >>> shared_out(np.array([1, 5, 100, 80]), 27).tolist()
    [1, 5, 11, 10]
    """
    ascending = np.sort(size)
    before = np.concatenate([[0], np.cumsum(ascending)[:-1]])
    room = (most - before) // np.arange(len(size), 0, -1)  # for each stratum from here on, were those before kept whole
    cut = np.flatnonzero(room < ascending)
    if not len(cut):
        return size
    count = np.minimum(size, room[cut[0]])
    more = np.flatnonzero(size > count)[: most - count.sum()]
    count[more] += 1
    return count


def evenly_spread(group: Int[np.ndarray, " n"], count: Int[np.ndarray, " g"]) -> Int[np.ndarray, " m"]:
    """Rows, ascending: `count` of each group, at even steps through its rows.

    >>> evenly_spread(np.array([0, 1, 0, 0, 0]), np.array([2, 1])).tolist()
    [1, 2, 4]
    """
    order = np.argsort(group, kind="stable")
    size = np.bincount(group, minlength=len(count))
    rank = np.arange(len(group)) - np.repeat(np.cumsum(size) - size, size)
    total, wanted = np.repeat(size, size), np.repeat(count, size)
    return np.sort(order[(rank + 1) * wanted // total > rank * wanted // total])
