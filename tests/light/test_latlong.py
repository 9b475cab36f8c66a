"""Lat-long maps of lobes: energy, place, frame, turning."""

import numpy as np
import pytest

from factorlib.conventions import YUP_FROM_CAMERA, lat_long_directions, lat_long_solid_angles
from factorlib.light.latlong import lat_long_of_lobes, map_energy, sample_map
from factorlib.light.lobes import Lobes

AXES = {
    "side": (0.7, -0.3, 0.6),
    "top": (0.0, -1.0, 0.0),
    "near the bottom": (0.003, 1.0, -0.004),
    "seam": (0.001, 0.2, 1.0),
}  # camera frame


def lobe(axis, sharpness: float) -> Lobes:
    axis = np.asarray(axis, float)[None]
    return Lobes(axis / np.linalg.norm(axis), np.array([sharpness]), np.array([[1.0, 0.5, 2.0]]))


@pytest.mark.parametrize("sharpness", [0.1, 5.0, 300.0, 5000.0, 1e6])
@pytest.mark.parametrize("axis", AXES.values(), ids=AXES)
def test_energy_of_the_map_is_the_sum_of_the_lobes_integrals(axis, sharpness):
    light = lobe(axis, sharpness)
    for height in (16, 128):
        np.testing.assert_allclose(map_energy(lat_long_of_lobes(light, height, 2 * height)), light.energy, rtol=1e-5)


@pytest.mark.parametrize("axis", AXES.values(), ids=AXES)
def test_texels_are_means_of_much_finer_point_samples(axis):
    light, height, finer = lobe(axis, 400.0), 8, 128
    weight = lat_long_solid_angles(height * finer, 2 * height * finer)
    directions = lat_long_directions(height * finer, 2 * height * finer).reshape(-1, 3)
    point = light.turned(YUP_FROM_CAMERA).radiance(directions).reshape(height, finer, 2 * height, finer, 3)
    expected = (
        np.einsum("ha,hawbc->hwc", weight.reshape(height, finer), point)
        / finer
        / weight.reshape(height, finer).sum(1)[:, None, None]
    )
    np.testing.assert_allclose(lat_long_of_lobes(light, height, 2 * height), expected, atol=1e-4)


@pytest.mark.parametrize(
    ("camera_axis", "row", "column"),
    [
        ((0, 0, -1), 0.5, 0.5),
        ((1, 0, 0), 0.5, 0.25),
        ((-1, 0, 0), 0.5, 0.75),
        ((0.01, -1, 0), 0.0, 0.25),
        ((0.01, 1, 0), 1.0, 0.25),
    ],
    ids=["viewer = centre", "right = a quarter", "left = three quarters", "up = top", "down = bottom"],
)
def test_lobe_lies_where_the_fixed_layout_says(camera_axis, row, column):
    height, width = 32, 64
    i, j = np.unravel_index(
        lat_long_of_lobes(lobe(camera_axis, 2000.0), height, width)[..., 0].argmax(), (height, width)
    )
    assert abs((i + 0.5) / height - row) <= 1 / height and abs((j + 0.5) / width - column) <= 1 / width


def test_sampling_at_texel_centres_gives_the_texels_also_beyond_the_poles():
    lat_long = np.random.default_rng(0).uniform(size=(6, 12, 3))
    np.testing.assert_allclose(sample_map(lat_long, lat_long_directions(6, 12)), lat_long, atol=1e-9)
    np.testing.assert_allclose(
        sample_map(lat_long, np.array([[1e-9, 1.0, 0.0]])), lat_long[None, 0, [2, 3, 8, 9]].mean(1), atol=1e-6
    )
