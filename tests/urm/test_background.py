"""Surroundings that a photo shows, by direction from its objects."""

import numpy as np
import pytest

from factorlib.conventions import YUP_FROM_CAMERA, lat_long_directions
from factorlib.geometry.camera import Camera
from factorlib.geometry.ground import Plane
from factorlib.urm.extract import RIM, ROWS, surrounding_radiance

CAMERA = Camera(160, 120, 110.0, (80.0, 60.0))
UP = np.array([0.0, -np.cos(0.4), -np.sin(0.4)])  # the camera looks down by 23°
CENTRE = np.array([0.1, 0.1, 3.0])
GROUND = Plane(UP, CENTRE - 0.5 * UP)
DIRECTIONS = lat_long_directions(ROWS, 2 * ROWS) @ YUP_FROM_CAMERA  # of texels, camera frame


def colour(direction):
    """A smooth radiance of the surroundings."""
    return np.exp(0.5 * direction)


def directions_shown(ground):
    """Directions from the objects to what each pixel shows, by hand: a ray that looks down meets the ground."""
    rays = CAMERA.rays()
    shown = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    if ground is None:
        return shown
    down = rays @ ground.normal
    points = rays * ((ground.point @ ground.normal) / down)[..., None]
    from_objects = points - CENTRE
    from_objects /= np.linalg.norm(from_objects, axis=-1, keepdims=True)
    return np.where(down[..., None] < 0, from_objects, shown)


def photo(ground=GROUND):
    channels = dict(zip("RGB", np.moveaxis(colour(directions_shown(ground)), -1, 0)))
    label = np.zeros((120, 160))
    label[40:80, 60:100] = 1
    zero = {name: np.zeros_like(label) for name in ("left_out", "clipped.R", "clipped.G", "clipped.B")}
    channels["R"] = np.where(label > 0, 50.0, channels["R"])  # the object is not of the surroundings
    return channels | zero | {"label": label}


@pytest.mark.parametrize("ground, least", [(GROUND, 0.15), (None, 0.02)])
def test_a_texel_has_the_radiance_that_comes_from_there(ground, least):
    found = surrounding_radiance(photo(ground), CAMERA, CENTRE, ground)
    seen = found.any(-1)
    solid = np.sin((np.arange(ROWS) + 0.5) / ROWS * np.pi)[:, None] * np.ones(2 * ROWS)
    assert solid[seen].sum() / solid.sum() > least
    np.testing.assert_allclose(found[seen], colour(DIRECTIONS)[seen], rtol=0.05)


def test_clipped_black_and_left_out_pixels_and_rims_are_no_observations():
    whole = photo()
    everything = surrounding_radiance(whole, CAMERA, CENTRE, GROUND).any(-1).sum()
    ones = np.ones_like(whole["label"])
    for changed in ({"clipped.G": ones}, {"left_out": ones}, {"B": 0 * ones}, {"R": np.nan * ones}):
        assert not surrounding_radiance(whole | changed, CAMERA, CENTRE, GROUND).any()
    left = ones.copy()
    left[:, : 80 + RIM] = 0
    assert 0.2 * everything < surrounding_radiance(whole | {"left_out": left}, CAMERA, CENTRE, GROUND).any(-1).sum()
    bright = dict(whole)
    border = np.zeros((120, 160), bool)
    border[40:80, 60 - RIM : 100 + RIM] = True
    bright["R"] = np.where(border & (whole["label"] == 0), 50.0, whole["R"])  # mixed with the object
    assert surrounding_radiance(bright, CAMERA, CENTRE, GROUND)[..., 0].max() < 2
