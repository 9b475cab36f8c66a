"""A pose as seven numbers, and what says how far it is to be believed: each follows the law it is named for."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from factorlib.align.coarse import looking_along, toward
from factorlib.align.refine import FocalPrior
from factorlib.align.search import focal_prior
from factorlib.align.silhouette import Silhouette
from factorlib.align.state import State, state_of
from factorlib.align.target import target_of
from factorlib.align.trust import contour_error, mirrored_score, normal_stderr_deg
from factorlib.geometry.camera import angle_between
from factorlib.geometry.sphere import fibonacci_directions
from tests.align.scenes import ball, blob, chair, mesh_of, photo_of, true_silhouette

KNOWN = FocalPrior(1.0, 0.0)


def seen(mesh, **how):
    """The caster, a target of the mask, the photo's camera, and the true state."""
    caster, camera, pose = photo_of(mesh, 1, **how)
    target = target_of(true_silhouette(caster, camera, pose), caster.mesh.labels, 200, 0.2)
    return caster, target, camera, state_of(pose, camera, caster)


def test_state_and_pose_are_one():
    caster, camera, pose = photo_of(blob(), seed=1, shift=(0.2, -0.1))
    back = state_of(pose, camera, caster).pose(caster)
    assert np.allclose(back.rotation, pose.rotation) and np.allclose(back.translation, pose.translation)


def test_focal_length_moves_neither_place_nor_size():
    state = State(np.eye(3), 0.1, -0.05, np.log(50.0), np.log(500.0))
    jacobian = state.jacobian(np.array([[0.0, 0, 0], [1.0, 0, 0]]))
    assert np.allclose(jacobian[0, :, 6], 0) and np.allclose(jacobian[1, :, 6], 0, atol=1e-9)


def test_rotations_look_where_they_say():
    for direction in fibonacci_directions(20):
        turn = looking_along(direction)
        assert np.allclose(turn @ direction, (0, 0, 1)) and np.isclose(np.linalg.det(turn), 1)
    slope = np.array([0.3, -0.2])
    assert np.allclose(np.cross(toward(slope) @ [0, 0, 1], [*slope, 1]), 0, atol=1e-12)
    assert np.isclose(angle_between(toward(slope), np.eye(3)), np.rad2deg(np.arctan(np.linalg.norm(slope))))


@pytest.mark.parametrize("larger", [0.04, -0.04, 0.1])
def test_a_ball_too_large_by_a_share_is_off_by_half_that_share_of_its_extent(larger):
    *given, state = seen(mesh_of([ball(subdivisions=5)]), focal=8.0)
    nearer = msgspec.structs.replace(state, log_depth=state.log_depth - np.log(1 + larger))
    assert contour_error(*given, state) < 0.002
    assert contour_error(*given, nearer) == pytest.approx(abs(larger) / 2, abs=0.003)


def test_contour_error_is_the_same_at_any_size():
    errors = []
    for fill in (0.9, 0.3):
        *given, state = seen(blob(), focal=20.0, fill=fill, width=640, height=480)
        errors.append(contour_error(*given, msgspec.structs.replace(state, log_depth=state.log_depth - 0.1)))
    assert errors[0] == pytest.approx(errors[1], rel=0.1)


def test_fewer_pixels_and_an_unknown_focal_length_tell_normals_less_and_the_turn_of_a_ball_costs_nothing():
    stderr = [normal_stderr_deg(*seen(chair(), fill=fill, width=640, height=480), KNOWN) for fill in (0.8, 0.2, 0.05)]
    assert stderr[0] < 1 and stderr[0] < stderr[1] < stderr[2] and stderr[2] > 3
    given = seen(chair())
    assert normal_stderr_deg(*given, FocalPrior(given[2].focal, 0.5)) >= 0.99 * normal_stderr_deg(*given, KNOWN)
    assert normal_stderr_deg(*seen(mesh_of([ball(subdivisions=5)])), KNOWN) < 2


def test_the_mirror_image_of_a_photo_off_centre_scores_as_the_photo_did():
    caster, camera, pose = photo_of(chair(), 21, focal=1.0, shift=(0.1, 0.05))
    camera = msgspec.structs.replace(camera, centre=(camera.centre[0] - 12.0, camera.centre[1] + 3.0))
    silhouette = true_silhouette(caster, camera, pose)
    flipped = Silhouette(np.ascontiguousarray(silhouette.label[:, ::-1]))
    mirrored = msgspec.structs.replace(camera, centre=(camera.width - camera.centre[0], camera.centre[1]))
    prior = focal_prior(camera.focal, "dataset", camera.width, camera.height)
    right, wrong = mirrored_score(caster, flipped, mirrored, prior), mirrored_score(caster, silhouette, camera, prior)
    assert right > 0.98 and 1 - right < (1 - wrong) / 2
