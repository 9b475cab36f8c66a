"""Pairs of photos that probably overlap, by matches among their largest features (preemptive matching, Wu 2013)."""

from collections.abc import Callable, Sequence
from itertools import combinations

import numpy as np
from jaxtyping import Float32, UInt8

LARGEST = 600  # features of a photo that are compared, those of the largest scales
NEIGHBOURS = 20  # photos that each photo is paired with, those with the most matches
ADJACENT = 2  # photos before and after, in order of names: frames of a video
RATIO = 0.8  # greatest angle to the nearest descriptor over that to the second, of a match (Lowe 2004)
UNIT = 512.0**2  # square of the length of SIFT's descriptors in bytes


def overlapping_pairs(
    descriptors: Sequence[UInt8[np.ndarray, "_ 128"]], report: Callable[[float], None] = lambda share: None
) -> list[tuple[int, int]]:
    """Return pairs (i, j), i < j, of photos in ascending order: each with its NEIGHBOURS, and ADJACENT ones.

    Args:
        descriptors: SIFT's descriptors of each photo's largest features, photos in order of their names.
        report: Called with the completed share, from 0 to 1.
    """
    photos = len(descriptors)
    counts = np.zeros((photos, photos), int)
    integers = [each.astype(np.float32) for each in descriptors]
    for i, j in combinations(range(photos), 2):
        if j == i + 1:
            report(i / photos)
        counts[i, j] = counts[j, i] = count_matches(integers[i], integers[j])
    nearest = np.argsort(-counts, axis=1, kind="stable")[:, :NEIGHBOURS]
    is_paired = np.zeros_like(counts, dtype=bool)
    np.put_along_axis(is_paired, nearest, True, axis=1)
    is_paired &= counts > 0
    is_paired |= np.abs(np.subtract.outer(range(photos), range(photos))) <= ADJACENT
    return [(i, j) for i, j in combinations(range(photos), 2) if is_paired[i, j] or is_paired[j, i]]


def count_matches(first: Float32[np.ndarray, "m 128"], second: Float32[np.ndarray, "n 128"]) -> int:
    """Return the number of mutual nearest neighbours whose second nearest is farther by 1/RATIO.

    Descriptors are integers, so that their products are exact whatever the order of the sums.
    """
    if min(len(first), len(second)) < 2:
        return 0
    products = first @ second.T
    rows = np.arange(len(first))
    nearest = products.argmax(axis=1)
    is_mutual = products.argmax(axis=0)[nearest] == rows
    greatest = products[rows, nearest]
    products[rows, nearest] = -1.0
    angles = np.arccos(np.minimum([greatest, products.max(axis=1)], UNIT) / UNIT)
    return int(np.count_nonzero(is_mutual & (angles[0] < RATIO * angles[1])))
