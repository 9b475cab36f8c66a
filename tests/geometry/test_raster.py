"""What a pixel sees, against a sphere known in closed form and against the laws of frames."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from factorlib.geometry.camera import Camera, Pose
from factorlib.geometry.raster import MIN_COSINE, Caster, rasterise, toward_viewer
from tests.align.scenes import at, ball, blob, chair, mesh_of, photo_of

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


def test_what_is_seen_faces_the_viewer_and_is_of_unit_length():
    maps = rasterise(*photo_of(blob(), seed=1, width=160, height=120))
    seen = maps.label > 0
    assert np.allclose(np.linalg.norm(maps.normal[seen], axis=1), 1) and not maps.normal[~seen].any()
    assert np.sum(maps.normal * maps.view, axis=-1)[seen].min() >= MIN_COSINE - 1e-9


def test_bending_a_normal_keeps_its_plane():
    view = np.array([[0.0, 0, -1]] * 2)
    normal = np.array([[0.6, 0, -0.8], [0.8, 0, 0.6]])
    bent, was = toward_viewer(normal, view)
    assert was.tolist() == [False, True] and np.allclose(bent[0], normal[0])
    assert np.allclose(bent[1], [np.sqrt(1 - MIN_COSINE**2), 0, -MIN_COSINE])


def test_turning_object_and_pose_together_changes_nothing():
    caster, camera, pose = photo_of(chair(), seed=2)
    turn = Rotation.random(rng=np.random.default_rng(3)).as_matrix()
    turned = msgspec.structs.replace(
        caster.mesh, vertices=caster.mesh.vertices @ turn.T, normals=caster.mesh.normals @ turn.T
    )
    first, second = (
        rasterise(caster, camera, pose),
        rasterise(turned, camera, Pose(pose.rotation @ turn.T, pose.translation)),
    )
    assert np.mean(first.label != second.label) < 1e-4
    assert np.quantile(np.abs(first.normal - second.normal), 0.999) < 1e-4


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


def test_a_caster_and_its_mesh_see_the_same():
    mesh = mesh_of([at(ball(), 3, 0, 0)])
    pose = Pose(np.eye(3), np.array([-3.0, 0, 4]))
    assert np.array_equal(rasterise(mesh, CAMERA, pose).normal, rasterise(Caster(mesh), CAMERA, pose).normal)
