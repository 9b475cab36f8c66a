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


def named(camera, pose, points=TIPS, off=0.0, seed=0) -> Keypoints:
    """The points where the camera sees them, each up to `off` pixels away from there."""
    shift = np.random.default_rng(seed).uniform(-off, off, (len(points), 2))
    return Keypoints(camera.project(pose.apply(points)) + shift, points)


def answered(caster, camera, keypoints, silhouette, focal):
    obj = ObjectToPlace("chair", caster, silhouette, keypoints=keypoints)
    return placed([obj], camera, KnownFocal(focal, "dataset" if focal else None), "photo")


def state(keypoints, caster, camera):
    prior = focal_prior(camera.focal, "dataset", camera.width, camera.height)
    return state_of_keypoints(keypoints, caster, camera, prior, "photo", "chair")


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("seed", [1, 2])
def test_careless_keypoints_and_the_mask_give_the_pose(seed, known):
    caster, camera, pose = photo_of(chair(), seed)
    keypoints, silhouette = named(camera, pose, off=2.0, seed=seed), true_silhouette(caster, camera, pose)
    result = answered(caster, camera, keypoints, silhouette, camera.focal if known else None)
    assert normal_error_deg(caster, camera, pose, result.camera, result.poses[0]) < 2
    assert result.found[0].by_keypoints and result.found[0].runner_up is None


def test_keypoints_decide_where_the_mask_cannot():
    """A ball looks the same from everywhere; the turn is the keypoints'."""
    caster, camera, pose = photo_of(mesh_of([ball()]), 3)
    keypoints = named(camera, pose, np.vstack([np.eye(3), -np.eye(3)]))
    result = answered(caster, camera, keypoints, true_silhouette(caster, camera, pose), camera.focal)
    assert np.allclose(result.poses[0].rotation, pose.rotation, atol=0.02)


def test_two_wrong_keypoints_of_eight_change_nothing():
    caster, camera, pose = photo_of(chair(), 4)
    pixel = named(camera, pose).pixel.copy()
    pixel[[1, 5]] = pixel[[5, 1]] + 30
    first, again = (state(Keypoints(pixel, TIPS), caster, camera) for _ in range(2))
    assert np.allclose(first.rotation, pose.rotation, atol=1e-3) and np.array_equal(first.rotation, again.rotation)


def test_units_and_origin_of_the_mesh_do_not_matter():
    caster, camera, pose = photo_of(chair(), 5)
    near, mesh, shift = named(camera, pose, off=1.0), caster.mesh, np.array([4e6, -1e6, 2e6])
    far = Caster(type(mesh)(mesh.vertices * 1000 + shift, mesh.faces, mesh.normals, mesh.face_label))
    one, other = state(near, caster, camera), state(Keypoints(near.pixel, near.point * 1000 + shift), far, camera)
    assert np.allclose(one.rotation, other.rotation, atol=1e-6)
    assert np.isclose(np.exp(other.log_depth), 1000 * np.exp(one.log_depth))


def test_keypoints_that_do_not_agree_are_refused():
    caster, camera, _ = photo_of(chair(), 6)
    keypoints = Keypoints(np.random.default_rng(0).uniform(0, 240, (8, 2)), TIPS)
    with pytest.raises(InputError, match=r"of the 8 keypoints of 'chair' agree") as caught:
        answered(caster, camera, keypoints, Silhouette(np.ones((240, 320), np.int16)), camera.focal)
    assert caught.value.key == "photo.chair.keypoints" and caught.value.cure
