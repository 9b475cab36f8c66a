"""Pairs of photos that are matched, from made features without pictures."""

from itertools import combinations

import numpy as np

from factorlib.shapes import pairs
from factorlib.shapes.pairs import ADJACENT, NEIGHBOURS, RATIO, count_matches, overlapping_pairs

RNG = np.random.default_rng(0)


def descriptors_of(points, noise=12.0):
    """SIFT's descriptors: bytes of length 512, which a photo changes a little."""
    unit = np.abs(points + RNG.normal(scale=noise / 512, size=points.shape))
    return np.round(512 * unit / np.linalg.norm(unit, axis=1, keepdims=True)).astype(np.uint8)


def world(number):
    """Unit descriptors of points."""
    points = np.abs(RNG.normal(size=(number, 128)))
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def walk(photos, reach, order):
    """Descriptors of photos of points on a ring: photo k stands at order[k], and sees `reach` points to either side."""
    ring = world(4 * photos)
    seen = [(4 * order[k] + np.arange(-reach, reach)) % len(ring) for k in range(photos)]
    return [descriptors_of(ring[RNG.permutation(points)]) for points in seen], seen


def test_all_photos_that_overlap_are_paired_and_of_others_only_neighbours_in_order():
    photos = 36
    descriptors, seen = walk(photos, 16, RNG.permutation(photos))
    overlapping = {(i, j) for i, j in combinations(range(photos), 2) if set(seen[i]) & set(seen[j])}
    in_order = {(i, j) for i, j in combinations(range(photos), 2) if j - i <= ADJACENT}
    assert 100 < len(overlapping) < photos * (photos - 1) / 4
    shares = []
    assert set(overlapping_pairs(descriptors, shares.append)) == overlapping | in_order
    assert shares == sorted(shares) and len(shares) == photos - 1


def test_where_all_photos_overlap_each_has_those_it_shares_most_with():
    photos = NEIGHBOURS + 15
    descriptors, seen = walk(photos, photos, np.arange(photos))
    result = set(overlapping_pairs(descriptors))
    apart = [min(j - i, photos - (j - i)) for i, j in result]
    assert len(result) < photos * (photos - 1) / 2 and {(0, k) for k in range(1, NEIGHBOURS // 2)} <= result
    assert max(apart) <= NEIGHBOURS // 2 + 3


def test_a_photo_of_another_thing_is_paired_with_its_neighbours_in_order_alone(monkeypatch):
    monkeypatch.setattr(pairs, "ADJACENT", 1)
    descriptors, _ = walk(12, 20, np.arange(12))
    descriptors[5], descriptors[8] = descriptors_of(world(40)), descriptors_of(world(1)[:0])
    result = overlapping_pairs(descriptors)
    assert [pair for pair in result if 5 in pair] == [(4, 5), (5, 6)]
    assert [pair for pair in result if 8 in pair] == [(7, 8), (8, 9)]


def test_matches_are_those_of_plain_loops():
    points = world(30)
    first, second = descriptors_of(points[:20], 25.0), descriptors_of(points[8:], 25.0)
    angles = np.arccos(first.astype(float) @ second.T.astype(float) / 512**2)
    expected = 0
    for i in range(len(first)):
        j = min(range(len(second)), key=lambda k, i=i: angles[i, k])
        others = [angles[i, k] for k in range(len(second)) if k != j]
        expected += min(range(len(first)), key=lambda k, j=j: angles[k, j]) == i and angles[i, j] < RATIO * min(others)
    assert count_matches(first.astype(np.float32), second.astype(np.float32)) == expected > 3
    assert expected < 12  # of some the second nearest is as near
