"""The search's coordinates have the derivatives they claim, and its views look where they say."""

from __future__ import annotations

import numpy as np

from factorlib.align.coarse import looking_along, toward
from factorlib.align.state import State, state_of
from factorlib.geometry.camera import Camera, angle_between, rotation_of_vector
from factorlib.geometry.sphere import fibonacci_directions
from tests.align.scenes import blob, photo_of

RNG = np.random.default_rng(0)


def test_state_and_pose_are_one():
    caster, camera, pose = photo_of(blob(), seed=1, shift=(0.2, -0.1))
    back = state_of(pose, camera, caster).pose(caster)
    assert np.allclose(back.rotation, pose.rotation) and np.allclose(back.translation, pose.translation)


def test_jacobian_is_the_finite_difference():
    camera = Camera(320, 240, 500.0, (160.0, 120.0))
    state = State(rotation_of_vector(np.array([0.3, -1.0, 0.4])), 0.1, -0.05, np.log(6.0), np.log(500.0))
    points, h = RNG.normal(size=(5, 3)), 1e-6

    def image(s: State):
        return s.camera(camera).project(points @ s.rotation.T + s.middle())

    jacobian = state.jacobian(points @ state.rotation.T)
    for k in range(7):
        step = np.eye(7)[k] * h
        assert np.allclose(
            jacobian[:, :, k], (image(state.moved(step)) - image(state.moved(-step))) / (2 * h), rtol=1e-5, atol=1e-5
        )


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
