"""Maps of a truth that are none, are of another size, or hold what no light is, are refused."""

import numpy as np
import pytest

from factorlib.errors import InputError
from factorlib.evaluate.truth import read_true_light, read_true_normals
from factorlib.images.exr import write_exr, write_rgb_exr

LIGHT = np.ones((4, 8, 3), np.float32)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, -7.0, -0.1])
def test_a_true_light_that_is_no_radiance(tmp_path, value):
    light = LIGHT.copy()
    light[1, 2, 0] = value
    write_rgb_exr(tmp_path / "a.exr", light)
    with pytest.raises(InputError) as caught:
        read_true_light(tmp_path / "a.exr", "hall")
    assert caught.value.key == "illumination.hall" and caught.value.cure


def test_a_little_below_zero_is_what_resampling_leaves(tmp_path):
    light = LIGHT.copy()
    light[1, 2, 0] = -1e-4
    write_rgb_exr(tmp_path / "a.exr", light)
    assert (read_true_light(tmp_path / "a.exr", "hall") == light).all()


@pytest.mark.parametrize(
    "channels, size, words",
    [
        ({"R": 0, "G": 0}, (8, 4), "has no channel B"),
        ({"normal.x": 0, "normal.y": 0}, (8, 4), "has no channel normal.z"),
        ({"R": 0, "G": 0, "B": 1}, (16, 8), "the normals have 8 × 4 pixels, the photo 16 × 8"),
        ({"R": 0, "G": 0, "B": np.inf}, (8, 4), "infinite"),
    ],
)
def test_true_normals_that_are_none(tmp_path, channels, size, words):
    write_exr(tmp_path / "a.exr", {name: np.full((4, 8), value, np.float32) for name, value in channels.items()})
    with pytest.raises(InputError, match=words) as caught:
        read_true_normals(tmp_path / "a.exr", "hall", size)
    assert caught.value.key == "normals.hall"


def test_a_normal_that_is_not_known_may_be_nan(tmp_path):
    write_exr(tmp_path / "a.exr", {f"normal.{axis}": np.full((4, 8), np.nan, np.float32) for axis in "xyz"})
    assert np.isnan(read_true_normals(tmp_path / "a.exr", "hall", (8, 4))).all()
