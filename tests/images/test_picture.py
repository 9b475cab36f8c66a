"""Pictures for people: exposure, encoding, and PNGs that are the same bytes every time."""

import numpy as np
import pytest

from factorlib.errors import InputError
from factorlib.images.picture import read_png, write_png

RNG = np.random.default_rng(5)


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
