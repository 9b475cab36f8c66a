"""The camera and poses agree with COLMAP's; sets of directions are even, mirrors where they should be."""

from __future__ import annotations

import numpy as np
import pycolmap
import pytest

from factorlib.geometry.camera import Camera
from factorlib.geometry.sphere import fibonacci_directions, fibonacci_sphere, mirror_directions
from tests.align.scenes import blob, photo_of

RNG = np.random.default_rng(0)


def test_projection_is_colmaps():
    _, camera, pose = photo_of(blob(), seed=0)
    points = RNG.normal(size=(20, 3))
    in_camera = pose.apply(points)
    there = pycolmap.Rigid3d(pycolmap.Rotation3d(pose.rotation), pose.translation)
    assert np.allclose(in_camera, np.array([there * p for p in points]))
    assert np.allclose(camera.project(in_camera), camera.colmap().img_from_cam(in_camera))


def test_rays_go_through_pixel_centres():
    camera = Camera(7, 5, 9.0, (3.0, 2.0))
    x, y = np.meshgrid(np.arange(7) + 0.5, np.arange(5) + 0.5)
    assert np.allclose(camera.project(camera.rays() * 3.7), np.stack([x, y], axis=-1))


def test_window_sees_the_same_directions():
    camera = Camera(64, 48, 80.0, (30.0, 25.0))
    window = camera.window(left=8, top=4, pixel=2, width=10, height=6)
    assert np.allclose(window.rays()[0, 0], [(8 + 1 - 30) / 80, (4 + 1 - 25) / 80, 1])


@pytest.mark.parametrize("lattice", [fibonacci_directions, fibonacci_sphere])
def test_directions_cover_the_sphere(lattice):
    directions = lattice(300)
    cosine = directions @ directions.T - 2 * np.eye(300)
    nearest = np.rad2deg(np.arccos(cosine.max(axis=1)))
    assert nearest.min() > 7 and nearest.max() < 14


def test_a_mirror_shows_what_lies_as_far_beyond_the_normal():
    rng = np.random.default_rng(0)
    normal, view = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in rng.normal(size=(2, 20, 3)))
    mirror = mirror_directions(normal, view)
    assert np.allclose(np.linalg.norm(mirror, axis=1), 1) and np.allclose(
        np.sum(mirror * normal, 1), np.sum(view * normal, 1)
    )
    assert np.allclose(mirror_directions(normal, mirror), view)
