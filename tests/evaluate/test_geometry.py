"""Angles by hand, and rotations that are known."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from factorlib.dataset.schema import Pose
from factorlib.evaluate.geometry import (
    RANDOM_ROTATION_DEG,
    averaged_normals,
    normal_error,
    pose_error,
    rotation_angle_deg,
)


@pytest.mark.parametrize("degrees", [0, 1e-3, 30, 90, 179])
def test_the_angle_of_a_turn_is_the_turn(degrees):
    base = Rotation.random(rng=np.random.default_rng(0)).as_matrix()
    turn = Rotation.from_rotvec(np.radians(degrees) * np.array([0.6, 0.0, 0.8])).as_matrix()
    assert rotation_angle_deg(turn @ base, base) == pytest.approx(degrees, abs=1e-5)


def test_random_rotations_are_as_far_as_the_null_says():
    turns = Rotation.random(20000, rng=np.random.default_rng(1))
    assert np.degrees(turns.magnitude()).mean() == pytest.approx(RANDOM_ROTATION_DEG, abs=0.6)


def test_translation_is_relative_to_the_true_distance():
    unit = tuple(tuple(r) for r in np.eye(3))
    assert pose_error(Pose(unit, (0, 0, 4.4)), Pose(unit, (0, 0, 4.0))).translation_relative == pytest.approx(0.1)


def test_normals_by_hand_and_only_where_both_are_known():
    truth = np.zeros((2, 2, 3))
    truth[..., 2] = -1.0
    estimate = truth.copy()
    estimate[0, 0] = [0.0, np.sin(0.1), -np.cos(0.1)]
    estimate[1, 1] = 0.0
    found = normal_error(estimate, truth, np.ones((2, 2), bool))
    assert found.pixels == 3 and found.estimate.median_deg == 0
    assert found.estimate.p90_deg == pytest.approx(0.8 * np.degrees(0.1))  # linear between the 2nd and the 3rd of three
    assert normal_error(estimate * 0, truth, np.ones((2, 2), bool)) is None


def test_true_normals_are_averaged_as_the_photo_was():
    normal = np.zeros((5, 8, 3))
    normal[:, :5] = [0.0, 0.0, -1.0]
    normal[0, 0], normal[1, 0] = [0.6, 0.0, -0.8], [-0.6, 0.0, -0.8]
    small = averaged_normals(normal, 2)
    assert small.shape == (2, 4, 3)
    np.testing.assert_allclose(
        small[:, :3], np.broadcast_to([0, 0, -1], (2, 3, 3)), atol=1e-12
    )  # half of a box is enough
    assert (small[:, 3] == 0).all()
    assert averaged_normals(normal, 1) is normal
