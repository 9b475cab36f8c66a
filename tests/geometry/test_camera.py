"""The camera and poses agree with COLMAP's."""

from __future__ import annotations

import numpy as np

from factorlib.geometry.camera import Camera
from tests.align.scenes import blob, photo_of

RNG = np.random.default_rng(0)


def test_projection_is_colmaps():
    _, camera, pose = photo_of(blob(), seed=0)
    points = RNG.normal(size=(20, 3))
    in_camera = pose.apply(points)
    assert np.allclose(in_camera, np.array([pose.colmap() * p for p in points]))
    assert np.allclose(camera.project(in_camera), camera.colmap().img_from_cam(in_camera))


def test_rays_go_through_pixel_centres():
    camera = Camera(7, 5, 9.0, (3.0, 2.0))
    x, y = np.meshgrid(np.arange(7) + 0.5, np.arange(5) + 0.5)
    assert np.allclose(camera.project(camera.rays() * 3.7), np.stack([x, y], axis=-1))


def test_window_sees_the_same_directions():
    camera = Camera(64, 48, 80.0, (30.0, 25.0))
    window = camera.window(left=8, top=4, pixel=2, width=10, height=6)
    assert np.allclose(window.rays()[0, 0], [(8 + 1 - 30) / 80, (4 + 1 - 25) / 80, 1])
