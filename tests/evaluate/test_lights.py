"""Three spheres and map errors: zero for the truth, blind to what the gauge allows, worse for the constant light."""

import numpy as np
import pytest

from factorlib.conventions import lat_long_directions
from factorlib.evaluate.ball import light_of_lat_long
from factorlib.evaluate.lights import compare_lights, light_error, mirrored_directions, rgb_angle
from tests.evaluate.made_artifacts import light_map

MAPS = {"a": light_map(1), "b": light_map(2)}
TRUTHS = {name: light_of_lat_long(value) for name, value in MAPS.items()}
HALF = lat_long_directions(32, 64)[..., 1] > 0


def compared(transform, mirrored=None):
    estimates = {name: light_of_lat_long(transform(name, value)) for name, value in MAPS.items()}
    return compare_lights(estimates, TRUTHS, mirrored or {})


def test_the_truth_is_perfect_and_the_null_is_not():
    for gauge, views in compared(lambda n, v: v).mean.items():
        for view, scored in views.items():
            assert scored.estimate.rmse < 1e-6, (gauge, view)
            assert scored.null.rmse > 0.1, (gauge, view)


def test_gauges_forgive_what_they_name():
    tinted = compared(lambda n, v: v * ([2.0, 1.0, 0.5] if n == "a" else [1.0, 1.0, 1.0])).mean
    assert tinted["none"]["mirror"].estimate.rmse > 0.2
    assert tinted["scalar_per_set"]["mirror"].estimate.rmse > 0.1
    assert tinted["channel_per_photo"]["mirror"].estimate.rmse < 1e-6
    assert compared(lambda n, v: 3 * v).mean["scalar_per_set"]["mirror"].estimate.rmse < 1e-6


def test_an_error_in_the_unseen_half_shows_there_only():
    mirrored = {name: HALF for name in MAPS}
    found = compared(lambda n, v: np.where(HALF[..., None], v, 0.0), mirrored).mean["none"]
    assert found["map_unmirrored"].estimate.rmse > 0.5 > 0.1 > found["map_mirrored"].estimate.rmse
    assert compared(lambda n, v: v, mirrored).mirrored_fraction["a"] == pytest.approx(0.5, abs=0.05)


def test_light_error_by_hand():
    truth = np.array([[1.0, 0, 0], [1.0, 0, 0]])
    turned = np.array([[0, 1.0, 0], [1.0, 0, 0]])
    assert rgb_angle(turned, truth) == pytest.approx(45)
    assert light_error(0.5 * truth, truth).rmse == pytest.approx(0.5)
    assert light_error(0.5 * truth, truth).rmse_scale_invariant == pytest.approx(0)


def test_a_black_estimate_is_scored_and_finite():
    scored = compared(lambda n, v: 0 * v).mean["channel_per_photo"]["mirror"].estimate
    assert (scored.rmse, scored.rgb_angle_deg) == (pytest.approx(1), 90)


def test_a_facing_normal_mirrors_the_viewer():
    front = np.array([[0.0, 0.0, -1.0]])
    mask = mirrored_directions(front, front, np.eye(3))
    beside = lat_long_directions(32, 64) @ [0, 0, 1] > 0.997
    assert beside.sum() == 4 and mask[beside].all()
    assert 0 < mask.mean() < 0.01


def test_a_light_fixed_to_the_world_is_seen_through_the_cameras_rotation():
    quarter = np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]])  # takes the camera's −z (the viewer) to the world's +x
    front = np.array([[0.0, 0.0, -1.0]])
    mask = mirrored_directions(front, front, quarter)
    assert mask[lat_long_directions(32, 64) @ [1, 0, 0] > 0.997].all() and mask.mean() < 0.01
