"""Cameras, poses and directions agree with COLMAP's and the laws of frames; what a pixel sees, with a sphere known in closed form."""

from __future__ import annotations

import msgspec
import numpy as np
import pycolmap
import pytest

from factorlib.geometry.camera import Camera, Pose
from factorlib.geometry.raster import rasterise
from factorlib.geometry.sphere import mirror_directions
from tests.align.scenes import ball, blob, mesh_of, photo_of

CAMERA = Camera(64, 48, 80.0, (30.0, 25.0))
STILL = Pose(np.eye(3), np.array([0.1, -0.2, 4.0]))


def test_sphere_in_closed_form():
    maps = rasterise(mesh_of([ball(subdivisions=5)]), CAMERA, STILL)
    x, y = np.meshgrid(np.arange(64) + 0.5, np.arange(48) + 0.5)  # pixel centres at 0.5
    ray = np.stack([(x - 30) / 80, (y - 25) / 80, np.ones_like(x)], axis=-1)
    a, b, c = np.sum(ray**2, axis=-1), ray @ STILL.translation, STILL.translation @ STILL.translation - 1
    inner = b**2 - a * c > 0.05  # away from the contour
    depth = (b - np.sqrt(np.maximum(b**2 - a * c, 0))) / a
    normal = ray * depth[..., None] - STILL.translation
    assert np.all(maps.label[inner] == 1) and np.all(maps.label[b**2 - a * c < -0.05] == 0)
    assert np.allclose(maps.depth[inner], depth[inner], atol=2e-3)
    assert np.rad2deg(np.arccos(np.clip(np.sum(maps.normal * normal, axis=-1)[inner], -1, 1))).max() < 1.0
    assert np.allclose(maps.view[inner], -(ray / np.sqrt(a)[..., None])[inner])


def test_millimetres_far_from_the_origin():
    caster, camera, pose = photo_of(blob(), seed=4)
    far = msgspec.structs.replace(caster.mesh, vertices=caster.mesh.vertices * 1000 + [1e6, -2e6, 5e5])
    moved = Pose(pose.rotation, pose.translation * 1000 - pose.rotation @ np.array([1e6, -2e6, 5e5]))
    near, far = rasterise(caster, camera, pose), rasterise(far, camera, moved)
    assert np.mean(near.label != far.label) < 2e-3
    both = (near.label > 0) & (far.label > 0)
    assert np.quantile(np.abs(near.normal - far.normal)[both], 0.99) < 1e-3
    assert np.allclose(near.depth[both] * 1000, far.depth[both], rtol=1e-3)


def test_inside_of_an_open_shell_is_marked_and_faces_the_viewer():
    bowl = ball()
    bowl.update_faces(bowl.triangles_center[:, 2] > 0)  # opening toward the camera at −z
    maps = rasterise(mesh_of([bowl]), CAMERA, STILL)
    seen = maps.label > 0
    assert maps.back[seen].mean() > 0.9 and maps.normal[seen][:, 2].max() < 0
    assert not rasterise(mesh_of([ball()]), CAMERA, STILL).back.any()


def test_nearest_of_several_objects_wins():
    near, far = mesh_of([ball(0.4)], [2]), mesh_of([ball(1.0)], [1])
    maps = rasterise([far, near], CAMERA, [STILL, Pose(np.eye(3), np.array([0.1, -0.2, 2.5]))])
    assert set(np.unique(maps.object)) == {0, 1, 2} and np.array_equal(maps.label == 2, maps.object == 2)
    assert maps.object[21, 32] == 2 and maps.depth[21, 32] == pytest.approx(2.1, abs=0.02)
    other = rasterise([near, far], CAMERA, [Pose(np.eye(3), np.array([0.1, -0.2, 2.5])), STILL])
    assert np.array_equal(other.label, maps.label) and np.array_equal(other.normal, maps.normal)


def test_projection_is_colmaps():
    _, camera, pose = photo_of(blob(), seed=0)
    points = np.random.default_rng(0).normal(size=(20, 3))
    in_camera = pose.apply(points)
    there = pycolmap.Rigid3d(pycolmap.Rotation3d(pose.rotation), pose.translation)
    assert np.allclose(in_camera, np.array([there * p for p in points]))
    assert np.allclose(camera.project(in_camera), camera.colmap().img_from_cam(in_camera))


def test_a_mirror_shows_what_lies_as_far_beyond_the_normal():
    rng = np.random.default_rng(0)
    normal, view = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in rng.normal(size=(2, 20, 3)))
    mirror = mirror_directions(normal, view)
    assert np.allclose(np.linalg.norm(mirror, axis=1), 1)
    assert np.allclose(np.sum(mirror * normal, 1), np.sum(view * normal, 1))
    assert np.allclose(mirror_directions(normal, mirror), view)
