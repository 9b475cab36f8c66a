"""Averaging down: means that keep what they should, and votes that do not move outlines."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from factorlib.images import boxes
from factorlib.images.boxes import box_majority, box_mean


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
