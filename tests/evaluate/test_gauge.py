"""Factors are least squares, undo what they name, and forgive more the more of them there are."""

import numpy as np
import pytest

from factorlib.evaluate.gauge import GAUGES, connected_components, gauge_factors

RNG = np.random.default_rng(3)
TRUTHS = [RNG.uniform(0.1, 1, (50, 3)) for _ in range(4)]


def test_one_scalar_is_undone_by_the_set():
    factors = gauge_factors([t * 0.25 for t in TRUTHS], TRUTHS, [1.0] * 4)
    assert factors["scalar_per_set"] == pytest.approx(np.full((4, 3), 4.0))
    assert factors["none"] == pytest.approx(np.ones((4, 3)))


def test_a_tint_per_photo_is_undone_only_by_the_last():
    tints = RNG.uniform(0.5, 2, (4, 3))
    factors = gauge_factors([t * c for t, c in zip(TRUTHS, tints)], TRUTHS, [1.0] * 4)
    assert factors["channel_per_photo"] == pytest.approx(1 / tints)
    assert not np.allclose(factors["scalar_per_set"], 1 / tints, rtol=0.1)


def test_each_gauge_fits_at_least_as_well_as_the_one_before():
    estimates = [t * RNG.uniform(0.5, 2, (50, 3)) for t in TRUTHS]
    factors = gauge_factors(estimates, TRUTHS, [1.0] * 4)
    left = [sum(((e * f - t) ** 2).sum() for e, f, t in zip(estimates, factors[g], TRUTHS)) for g in GAUGES]
    assert left[0] >= left[1] >= left[2]


def test_the_scalar_is_a_minimum():
    estimates, whites = [t * RNG.uniform(0.5, 2, (50, 3)) for t in TRUTHS], [0.5, 1, 2, 3]
    best = gauge_factors(estimates, TRUTHS, whites)["scalar_per_set"][0, 0]

    def left(f):
        return sum(((e * f - t) ** 2).sum() / w**2 for e, t, w in zip(estimates, TRUTHS, whites))

    assert left(best) < min(left(best * 1.01), left(best * 0.99))


def test_black_and_empty_estimates_need_no_factor():
    factors = gauge_factors([np.zeros((5, 3)), np.zeros((0, 3))], [np.ones((5, 3)), np.zeros((0, 3))], [1.0, 1.0])
    assert all(np.array_equal(f, np.ones((2, 3))) for f in factors.values())


def test_components_do_not_depend_on_order():
    pairs = {"a": ["x", "y"], "b": ["z"], "c": ["y", "w"], "d": ["v", "z"]}
    found = connected_components(pairs)
    assert found == {"v": 0, "z": 0, "w": 1, "x": 1, "y": 1}
    assert connected_components({k: pairs[k][::-1] for k in reversed(pairs)}) == found


def test_one_wrong_highlight_does_not_decide_a_pictures_factor():
    truth = TRUTHS[0].copy()
    estimate = truth / 2
    truth[0], estimate[0] = 50.0, 500.0
    whole, below = (gauge_factors([estimate], [truth], [1.0], below_white=b)["channel_per_photo"] for b in (False, True))
    assert below == pytest.approx(np.full((1, 3), 2.0)) and whole.max() < 0.2
