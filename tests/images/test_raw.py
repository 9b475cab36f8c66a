"""Raw photos: what the sensor saw, not the preview beside it; linear, and clipped where the sensor was."""

import numpy as np
import pytest

from factorlib.errors import InputError
from factorlib.images.photo import read_photo
from tests.images.made_dng import BLACK, LONG, RATIONAL, SHORT, WHITE, write_dng

H, W = 48, 64
EXIF = {
    33434: (RATIONAL, [1 / 50]),
    33437: (RATIONAL, [2.0]),
    34855: (SHORT, [200]),
    41989: (SHORT, [26]),
    40962: (LONG, [W]),
}


def sensor_of(rgb: np.ndarray) -> np.ndarray:
    """Codes of a sensor that sees linear `rgb` in [0, 1], [h, w, 3]."""
    codes = BLACK + rgb * (WHITE - BLACK)
    pattern = np.array([[0, 1], [1, 2]])[np.arange(rgb.shape[0])[:, None] % 2, np.arange(rgb.shape[1])[None] % 2]
    return np.rint(np.take_along_axis(codes, pattern[..., None], axis=2)[..., 0]).astype(np.uint16)


def halves() -> np.ndarray:
    """Left grey of .2, right (.4, .3, .2); an upper band of half of it."""
    rgb = np.full((H, W, 3), 0.2)
    rgb[:, W // 2 :] = (0.4, 0.3, 0.2)
    rgb[: H // 3] /= 2
    return rgb


@pytest.mark.parametrize("name", ["a.dng", "A.DNG", "a.tif"])
def test_a_dng_is_what_the_sensor_saw_by_whatever_name_however_bright_the_picture(tmp_path, name):
    for brightness in (1, 0.25):
        photo = read_photo(write_dng(tmp_path / name, sensor_of(brightness * halves()), exif=EXIF))
        assert (photo.width, photo.height, photo.encoding) == (W, H, "linear") and not photo.clipped.any()
        below = slice(H // 3 + 4, -4)
        above = slice(4, H // 3 - 4)
        left = slice(4, W // 2 - 4)
        right = slice(W // 2 + 4, -4)
        for where, expected in (
            ((below, left), (0.2,) * 3),
            ((below, right), (0.4, 0.3, 0.2)),
            ((above, left), (0.1,) * 3),
        ):
            seen = photo.radiance[where].mean((0, 1))
            np.testing.assert_allclose(seen, np.multiply(expected, brightness), rtol=0.02)
    assert photo.exposure == pytest.approx(200 / 50 / 4)
    assert photo.focal_px == pytest.approx(26 / np.hypot(36, 24) * np.hypot(W, H))


def test_the_cameras_white_balance_is_applied(tmp_path):
    seen = halves() * (0.5, 1.0, 0.8)  # the sensor sees less red and blue
    lower = read_photo(write_dng(tmp_path / "a.dng", sensor_of(seen), neutral=(0.5, 1.0, 0.8))).radiance[H // 2 : -4]
    grey, coloured = lower[:, 6 : W // 2 - 6].mean((0, 1)), lower[:, W // 2 + 6 : -4].mean((0, 1))
    np.testing.assert_allclose(grey / grey[1], 1, rtol=0.02)
    np.testing.assert_allclose(coloured / grey, (2, 1.5, 1), rtol=0.03)


def test_what_the_sensors_white_level_cut_is_clipped_in_all_channels(tmp_path):
    sensor = sensor_of(halves())
    sensor[24:26, 40:42] = WHITE
    clipped = read_photo(write_dng(tmp_path / "a.dng", sensor)).clipped
    assert clipped[24:26, 40:42].all()
    assert not (clipped[:20].any() or clipped[30:].any() or clipped[:, :36].any())


def test_a_damaged_raw_file_is_refused_with_the_command_that_develops_it(tmp_path):
    whole = write_dng(tmp_path / "a.dng", sensor_of(halves())).read_bytes()
    for broken in (b"no raw file", whole[:100], whole[: len(whole) // 2]):
        (tmp_path / "a.dng").write_bytes(broken)
        with pytest.raises(InputError) as caught:
            read_photo(tmp_path / "a.dng", key="photos[0].image")
        assert "photos[0].image" in str(caught.value) and "darktable-cli a.dng a.tif" in str(caught.value)
