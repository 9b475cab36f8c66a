"""Pictures for people: exposure, encoding, and PNGs that are the same bytes every time."""

import time

import numpy as np
import pytest

from factorlib.errors import InputError
from factorlib.images.picture import exposure_of, picture, read_png, write_png

RNG = np.random.default_rng(5)


def test_scaling_the_light_changes_no_picture_that_exposes_itself():
    radiance = RNG.uniform(0, 7, (8, 9, 3))
    np.testing.assert_array_equal(picture(radiance), picture(radiance * 16))
    assert exposure_of(radiance * 16) == pytest.approx(exposure_of(radiance) / 16)


def test_exposure_looks_only_where_it_is_told():
    radiance = np.ones((4, 4, 3))
    radiance[0] = 1000
    where = np.ones((4, 4), dtype=bool)
    where[0] = False
    assert exposure_of(radiance, where) == 1


@pytest.mark.parametrize("radiance", [np.zeros((2, 2, 3)), np.full((2, 2, 3), np.nan)])
def test_nothing_to_expose_for(radiance):
    assert exposure_of(radiance) == 1 and picture(radiance).max() == 0


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_png_round_trip_keeps_colours_under_alpha(tmp_path, channels):
    pixels = RNG.integers(0, 256, (7, 5, channels), dtype=np.uint8)
    write_png(tmp_path / "a.png", pixels)
    np.testing.assert_array_equal(read_png(tmp_path / "a.png"), pixels)


def test_png_has_no_date_and_is_the_same_bytes_later(tmp_path):
    pixels = RNG.integers(0, 256, (7, 5, 3), dtype=np.uint8)
    write_png(tmp_path / "a.png", pixels)
    time.sleep(1.1)  # a date in it would have another second
    write_png(tmp_path / "b.png", pixels)
    data = (tmp_path / "a.png").read_bytes()
    assert data == (tmp_path / "b.png").read_bytes() and b"tIME" not in data and b"tEXt" not in data


def test_unreadable_png_is_refused(tmp_path):
    (tmp_path / "a.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    with pytest.raises(InputError, match="a.png"):
        read_png(tmp_path / "a.png")
