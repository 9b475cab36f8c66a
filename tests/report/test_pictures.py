"""Pictures keep their mean, their outline and their file."""

import numpy as np
import pytest

from factorlib.report.pictures import box_of, outline, reduced


@pytest.mark.parametrize("size", [(100, 60), (61, 97)])
def test_reducing_keeps_the_mean_and_a_constant(size):
    picture = np.random.default_rng(2).uniform(size=(*size, 3)).astype(np.float32)
    small = reduced(picture, 25)
    assert max(small.shape[:2]) == 25 and small.mean() == pytest.approx(picture.mean(), rel=1e-4)
    assert reduced(np.ones((*size, 1), np.float32), 25) == pytest.approx(np.ones((*small.shape[:2], 1)), rel=1e-5)
    assert reduced(picture, 200) is picture


def test_the_box_is_the_mask_with_a_margin_and_the_outline_one_pixel_wide_and_open_at_the_border():
    mask = np.zeros((50, 60), bool)
    mask[10:20, 0:30] = True
    assert box_of(mask, 0.1) == (slice(7, 23), slice(0, 33)) and box_of(mask & False) == (slice(0, 50), slice(0, 60))
    mask, expected = np.zeros((2, 6, 6), bool)
    mask[:4, :4], expected[3, :4], expected[:4, 3] = True, True, True
    assert np.array_equal(outline(mask), expected)
