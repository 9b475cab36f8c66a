"""Gauges for the comparison of an estimate with the truth.

A factor per colour channel can move between all materials and all lights that observations link, and the exposure of a
photo is unknown.  An error is therefore reported in three gauges:

none               nothing is scaled
scalar_per_set     one number scales everything in the set
channel_per_photo  one number for each channel and each photo (light, relit picture): the most lenient, where even a
                   grey ball scores well, so it is never to be reported alone

Each factor is the least-squares one, Σ e·t / Σ e².  Every picture has the weight 1 / white², so that a bright photo
does not outweigh a dark one.  For pictures, samples brighter than white in estimate or truth are left out.  The tone
map clips them, and one wrong highlight would dominate.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import TypeVar

import numpy as np
from jaxtyping import Float
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components as components_of_graph

Samples = Float[np.ndarray, "_ 3"]
Error = TypeVar("Error")
GAUGES = ("none", "scalar_per_set", "channel_per_photo")


def gauge_factors(
    estimates: Sequence[Samples], truths: Sequence[Samples], whites: Sequence[float], below_white: bool = False
) -> dict[str, Float[np.ndarray, "photos 3"]]:
    """Return the factors on the estimates in each gauge, per photo and channel.

    Args:
        estimates: samples of each photo
        truths: true samples of each photo
        whites: white of each photo
        below_white: leave out samples brighter than white
    """
    if below_white:
        dark = [np.maximum(e, t).max(axis=-1) <= w for e, t, w in zip(estimates, truths, whites, strict=True)]
        estimates, truths = ([s[k] for s, k in zip(samples, dark, strict=True)] for samples in (estimates, truths))
    cross = np.array([(e * t).sum(axis=0) / w**2 for e, t, w in zip(estimates, truths, whites)]).reshape(-1, 3)
    square = np.array([(e * e).sum(axis=0) / w**2 for e, w in zip(estimates, whites)]).reshape(-1, 3)
    return {
        "none": np.ones_like(cross),
        "scalar_per_set": np.full_like(cross, _ratio(cross.sum(), square.sum())),
        "channel_per_photo": _ratio(cross, square),
    }


def errors_by_gauge(
    estimates: Mapping[str, Sequence[Samples]],
    truths: Sequence[Samples],
    whites: Sequence[float],
    error: Callable[[Samples, int], Error],
    below_white: bool = False,
) -> list[dict[str, dict[str, Error]]]:
    """Return the errors of each photo, by gauge and kind of estimate.

    Args:
        estimates: samples of each photo, by kind; each kind is scaled by its own factors
        truths: true samples of each photo
        whites: white of each photo
        error: error of the scaled estimate of the photo with the given index
        below_white: leave out samples brighter than white
    """
    factors = {kind: gauge_factors(samples, truths, whites, below_white) for kind, samples in estimates.items()}
    return [
        {g: {kind: error(e[i] * factors[kind][g][i], i) for kind, e in estimates.items()} for g in GAUGES}
        for i in range(len(truths))
    ]


def _ratio(cross: np.ndarray | float, square: np.ndarray | float) -> np.ndarray:
    """Return cross / square, and 1 where square is 0."""
    square = np.asarray(square)
    return np.where(square > 0, cross / np.where(square > 0, square, 1.0), 1.0)


def material_components(pairs: Mapping[str, Sequence[str]]) -> dict[str, int]:
    """Return the connected component of each material, given the materials observed in each light.

    A light links the materials observed in it.  Components are numbered by their first material's name.

    >>> material_components({"day": ["red", "white"], "night": ["blue"]})
    {'blue': 0, 'red': 1, 'white': 1}
    """
    names = sorted({name for members in pairs.values() for name in members})
    linked = [(names.index(members[0]), names.index(name)) for members in pairs.values() for name in members]
    first, second = np.array(linked, dtype=int).reshape(-1, 2).T
    graph = coo_array((np.ones(len(linked)), (first, second)), shape=(len(names), len(names)))
    _, label = components_of_graph(graph, directed=False)
    order = list(dict.fromkeys(label.tolist()))
    return {name: order.index(number) for name, number in zip(names, label.tolist(), strict=True)}
