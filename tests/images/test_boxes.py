"""Averaging down: means that keep what they should, and votes that do not move outlines."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from factorlib.images import boxes
from factorlib.images.boxes import box_any, box_majority, box_mean, least_factor

RNG = np.random.default_rng(5)


@settings(max_examples=30)
@given(st.floats(0, 1e6, width=32), st.integers(1, 6), st.integers(1, 5), st.integers(1, 5))
def test_the_mean_is_that_of_the_whole_and_a_constant_stays_what_it_is_to_the_last_bit(value, factor, rows, columns):
    shape = rows * factor, columns * factor
    radiance = np.random.default_rng(factor).exponential(1, (*shape, 3)).astype(np.float32)
    mean, some = box_mean(radiance, np.ones(shape, bool), factor)
    assert mean.shape == (rows, columns, 3) and mean.dtype == np.float32 and some.all()
    np.testing.assert_allclose(mean.mean((0, 1), dtype=float), radiance.mean((0, 1), dtype=float), rtol=1e-6)
    assert (
        box_mean(np.full((*shape, 3), value, np.float32), np.ones(shape, bool), factor)[0] == np.float32(value)
    ).all()


def test_left_over_and_not_finite_parts_have_no_share_and_a_box_is_clipped_where_any_part_is():
    radiance = RNG.random((9, 11, 3)).astype(np.float32)
    mean, _ = box_mean(radiance, np.ones((9, 11), bool), 4)
    assert mean.shape == (2, 2, 3)
    np.testing.assert_allclose(mean[1, 1], radiance[4:8, 4:8].mean((0, 1)), rtol=1e-6)
    radiance, finite = radiance[:4, :4], np.ones((4, 4), bool)
    finite[0, 1] = finite[2:, 2:] = False
    mean, some = box_mean(np.where(finite[..., None], radiance, 0), finite, 2)
    np.testing.assert_allclose(mean[0, 0], (radiance[0, 0] + radiance[1, 0] + radiance[1, 1]) / 3, rtol=1e-6)
    assert some.tolist() == [[True, True], [True, False]] and (mean[1, 1] == 0).all()
    clipped = np.zeros((4, 6, 3), bool)
    clipped[3, 5, 1] = True
    assert np.argwhere(box_any(clipped, 2)).tolist() == [[1, 2, 1]]


@settings(max_examples=30)
@given(
    arrays(np.uint8, (6, 9), elements=st.sampled_from([0, 1, 2, 255])), st.sampled_from([1, 2, 3]), st.integers(1, 60)
)
def test_no_value_has_more_votes_than_the_winner_however_many_rows_vote_at_once(values, factor, at_once):
    won = box_majority(values, factor)
    for i, j in np.ndindex(won.shape):
        box = values[i * factor : (i + 1) * factor, j * factor : (j + 1) * factor]
        votes = np.bincount(box.ravel())
        assert votes[won[i, j]] == votes.max()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(boxes, "VOTED_AT_ONCE", at_once)
        np.testing.assert_array_equal(box_majority(values, factor), won)


@pytest.mark.parametrize("shift", [0, 1])
def test_ties_neither_grow_nor_move_an_outline(shift):
    picture = np.zeros((40, 80), np.uint8)
    picture[:, 20 + shift : 60 + shift] = 1  # 40 wide; where shifted, both of its edges halve boxes
    small = box_majority(picture, 2)
    assert small.sum() * 4 == picture.sum()
    assert np.nonzero(small)[1].mean() + 0.5 == pytest.approx((np.nonzero(picture)[1].mean() + 0.5) / 2)


@given(st.integers(0, 10**9), st.integers(1, 10**6))
def test_the_factor_is_the_least_that_fits(pixels, most):
    factor = least_factor(pixels, most)
    assert pixels <= most * factor**2 and (factor == 1 or pixels > most * (factor - 1) ** 2)
