"""Pictures for people: exposure, encoding, and PNGs that are the same bytes every time."""

import numpy as np
import pytest

from factorlib.errors import InputError
from factorlib.images.picture import exposure_of, picture, read_png, write_png

RNG = np.random.default_rng(5)


def test_scaling_the_light_changes_no_picture_that_exposes_itself_for_what_it_is_told_to():
    radiance = RNG.uniform(0, 7, (8, 9, 3))
    np.testing.assert_array_equal(picture(radiance), picture(radiance * 16))
    assert exposure_of(radiance * 16) == pytest.approx(exposure_of(radiance) / 16)
    radiance = np.concatenate([np.full((1, 4, 3), 1000.0), np.ones((3, 4, 3))])
    assert exposure_of(radiance, radiance[..., 0] == 1) == 1
    for nothing in (0.0, np.nan):
        assert exposure_of(np.full((2, 2, 3), nothing)) == 1 and picture(np.full((2, 2, 3), nothing)).max() == 0


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_a_png_keeps_colours_under_alpha_and_has_no_date(tmp_path, channels):
    pixels = RNG.integers(0, 256, (7, 5, channels), dtype=np.uint8)
    write_png(tmp_path / "a.png", pixels)
    np.testing.assert_array_equal(read_png(tmp_path / "a.png"), pixels)
    data = (tmp_path / "a.png").read_bytes()
    assert b"tIME" not in data and b"tEXt" not in data
    (tmp_path / "a.png").write_bytes(data[:8])
    with pytest.raises(InputError, match="a.png"):
        read_png(tmp_path / "a.png")
