"""A data URI holds the PNG, and reducing keeps the mean."""

import base64

import numpy as np
import pytest

from factorlib.images.picture import png_bytes
from factorlib.report.pictures import box_of, data_uri, outline, reduced


def test_the_data_uri_holds_the_file():
    pixels = np.zeros((2, 2, 3), np.uint8)
    head, data = data_uri(pixels).split(",")
    assert head == "data:image/png;base64" and base64.b64decode(data) == png_bytes(pixels)


@pytest.mark.parametrize("size", [(100, 60), (61, 97)])
def test_reducing_keeps_the_mean_and_a_constant(size):
    picture = np.random.default_rng(2).uniform(size=(*size, 3)).astype(np.float32)
    small = reduced(picture, 25)
    assert max(small.shape[:2]) == 25 and small.mean() == pytest.approx(picture.mean(), rel=1e-4)
    assert reduced(np.ones((*size, 1), np.float32), 25) == pytest.approx(np.ones((*small.shape[:2], 1)), rel=1e-5)
    assert reduced(picture, 200) is picture


def test_the_box_is_the_mask_with_a_margin_inside_the_picture():
    mask = np.zeros((50, 60), bool)
    mask[10:20, 0:30] = True
    assert box_of(mask, 0.1) == (slice(7, 23), slice(0, 33))
    assert box_of(mask & False) == (slice(0, 50), slice(0, 60))


def test_an_outline_is_one_pixel_wide_and_open_at_the_border():
    mask = np.zeros((6, 6), bool)
    mask[:4, :4] = True
    expected = np.zeros_like(mask)
    expected[3, :4] = expected[:4, 3] = True
    assert np.array_equal(outline(mask), expected)
