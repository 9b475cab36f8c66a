"""Factors of a shape's axes: the derivative of image points by them."""

import numpy as np

from factorlib.align.state import pose_state
from factorlib.shapes.proportions import BOX, jacobian_with_shape
from tests.align.scenes import chair, photo_of


def test_image_points_move_by_the_derivative():
    rng = np.random.default_rng(0)
    caster, camera, pose = photo_of(chair(), 1)
    state = pose_state(pose, camera, caster)
    points = rng.normal(size=(30, 3))

    def image(step, shape):
        moved = state.moved(step)
        return moved.camera(camera).project(points * np.exp(BOX @ shape) @ moved.rotation.T + moved.middle())

    numeric, h = np.empty((30, 2, 9)), 1e-6
    for k, step in enumerate(h * np.eye(9)):
        numeric[..., k] = (image(step[:7], step[7:]) - image(-step[:7], -step[7:])) / (2 * h)
    assert np.allclose(jacobian_with_shape(state, points @ state.rotation.T), numeric, rtol=1e-4, atol=1e-3)
