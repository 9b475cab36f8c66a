"""Keypoints named by the user: a pose from few of them, some wrong, the focal length known or not."""

from __future__ import annotations

import numpy as np
import pytest

from factorlib.align.keypoints import Keypoints, state_of_keypoints
from factorlib.align.place import KnownFocal, ObjectToPlace, placed
from factorlib.align.search import focal_prior
from factorlib.align.silhouette import Silhouette
from factorlib.errors import InputError
from factorlib.geometry.raster import Caster
from tests.align.scenes import ball, chair, mesh_of, normal_error_deg, photo_of, true_silhouette

TIPS = np.array([[-0.5, -0.5, 0.05], [0.5, -0.5, 0.05], [0.5, 0.5, 0.05], [-0.45, 0.5, 1.0], [-0.45, -0.5, 1.0], [0.4, 0.4, -0.95], [-0.4, -0.4, -0.95], [0.4, -0.4, -0.95]])  # fmt: skip


def seen_in(camera, pose, points=TIPS, off=0.0, seed=0) -> Keypoints:
    """The points where the camera sees them, each up to `off` pixels away from there."""
    shift = np.random.default_rng(seed).uniform(-off, off, (len(points), 2))
    return Keypoints(camera.project(pose.apply(points)) + shift, points)


def answered(obj, camera, focal):
    result = placed([obj], camera, KnownFocal(focal, "dataset" if focal else None), "photo")
    return result, result.poses[0]


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("seed", [1, 2])
def test_careless_keypoints_and_the_mask_give_the_pose(seed, known):
    caster, camera, pose = photo_of(chair(), seed)
    keypoints = seen_in(camera, pose, off=2.0, seed=seed)
    obj = ObjectToPlace("chair", caster, true_silhouette(caster, camera, pose), keypoints=keypoints)
    result, found = answered(obj, camera, camera.focal if known else None)
    assert normal_error_deg(caster, camera, pose, result.camera, found) < 2
    assert result.found[0].by_keypoints and result.found[0].runner_up is None


def test_keypoints_decide_where_the_mask_cannot():
    """A ball looks the same from everywhere; the turn is the keypoints'."""
    caster, camera, pose = photo_of(mesh_of([ball()]), 3)
    points = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [-1, 0, 0], [0, -1, 0], [0, 0, -1]], float)
    obj = ObjectToPlace("ball", caster, true_silhouette(caster, camera, pose), keypoints=seen_in(camera, pose, points))
    _, found = answered(obj, camera, camera.focal)
    assert np.allclose(found.rotation, pose.rotation, atol=0.02)


def test_two_wrong_keypoints_of_eight_change_nothing():
    caster, camera, pose = photo_of(chair(), 4)
    prior = focal_prior(camera.focal, "dataset", camera.width, camera.height)
    right = seen_in(camera, pose)
    pixel = right.pixel.copy()
    pixel[[1, 5]] = pixel[[5, 1]] + 30
    state = state_of_keypoints(Keypoints(pixel, right.point), caster, camera, prior, "photo", "chair")
    assert np.allclose(state.pose(caster).rotation, pose.rotation, atol=1e-3)
    again = state_of_keypoints(Keypoints(pixel, right.point), caster, camera, prior, "photo", "chair")
    assert np.array_equal(state.rotation, again.rotation)


def test_units_and_origin_of_the_mesh_do_not_matter():
    caster, camera, pose = photo_of(chair(), 5)
    prior = focal_prior(camera.focal, "dataset", camera.width, camera.height)
    keypoints = seen_in(camera, pose, off=1.0)
    mesh, shift = caster.mesh, np.array([4e6, -1e6, 2e6])
    far = Caster(type(mesh)(mesh.vertices * 1000 + shift, mesh.faces, mesh.normals, mesh.face_label))
    near = state_of_keypoints(keypoints, caster, camera, prior, "photo", "chair")
    other = state_of_keypoints(
        Keypoints(keypoints.pixel, keypoints.point * 1000 + shift), far, camera, prior, "photo", "chair"
    )
    assert np.allclose(near.rotation, other.rotation, atol=1e-6) and np.isclose(
        np.exp(other.log_depth), 1000 * np.exp(near.log_depth)
    )


def test_keypoints_that_do_not_agree_are_refused():
    caster, camera, pose = photo_of(chair(), 6)
    pixel = np.random.default_rng(0).uniform(0, 240, (8, 2))
    obj = ObjectToPlace("chair", caster, Silhouette(np.ones((240, 320), np.int16)), keypoints=Keypoints(pixel, TIPS))
    with pytest.raises(InputError, match=r"of the 8 keypoints of 'chair' agree") as caught:
        answered(obj, camera, camera.focal)
    assert caught.value.key == "photo.chair.keypoints" and caught.value.cure
