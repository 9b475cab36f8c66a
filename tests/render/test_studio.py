"""A floor takes the shadow of what stands on it, fades out, and changes nothing else."""

import numpy as np
import pytest

from factorlib.geometry.camera import Camera
from factorlib.render.ground import Plane
from factorlib.render.photo_scene import Orbit, PhotoScene, traced_photo
from factorlib.render.studio import on_floor
from tests.render.test_photo_scene import MATERIALS, lobes, placed, sphere

PLANE = Plane(np.array([0.0, 1.0, 0.0]), np.array([0.0, -1.0, -6.0]))


@pytest.fixture(scope="module")
def scene():
    return PhotoScene(
        Camera(60, 48, 50.0, (30.0, 24.0)), (placed("ball", sphere(1.0), (0, 0, -6)),), lobes(), MATERIALS
    )


def test_a_shadow_lies_beneath_the_ball_and_nothing_far_from_it(scene):
    view = Orbit(0, 25).world_from_camera(scene)
    plain, dark, pale = (
        traced_photo(scene, 64, view) if share is None else on_floor(scene, PLANE, share, 64, view)
        for share in (None, 0.0, 0.8)
    )
    assert (pale[:3, :, 3] == plain[:3, :, 3]).all(), "the sky is empty as before"
    fading = (plain[..., 3] == 0) & (pale[..., 3] > 0.1) & (pale[..., 3] < 0.9)
    assert fading.sum() > 100, "the floor ends without an edge"
    inside, below = plain[..., 3] > 0.99, (plain[..., 3] == 0) & (pale[..., 3] > 0.5)
    assert below.sum() > 100 and np.abs(dark[below][:, :3]).max() < 1e-6
    rows, columns = np.nonzero(below)
    middle = np.abs(columns - 30) < 4
    colour = pale[..., :3] / np.maximum(pale[..., 3:], 1e-6)
    foot = colour[rows[middle].min(), 27:34].mean()  # at the ball's contact
    assert foot < 0.7 * colour[below].mean(), "where it stands, less light comes"
    assert pale[inside][:, :3].mean() > dark[inside][:, :3].mean(), "the floor lights the ball"
    np.testing.assert_allclose(dark[inside][:, :3].mean(), plain[inside][:, :3].mean(), rtol=0.35)


def test_about_a_tilted_normal_the_camera_keeps_its_height_and_its_distance(scene):
    up = np.array([0.0, 0.8, 0.6])
    places = np.array([Orbit(azimuth).world_from_camera(scene, up)[:3, 3] - scene.middle for azimuth in (0, 90, 180)])
    np.testing.assert_allclose(places @ up, np.full(3, places[0] @ up), atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(places, axis=1), np.linalg.norm(scene.middle), atol=1e-9)
