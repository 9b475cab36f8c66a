"""The prior on natural light: what its covariance must be."""

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from factorlib.geometry.sphere import fibonacci_sphere
from factorlib.light.prior import MIX, LightPrior, read_light_prior

KNOWN = LightPrior(
    variance=(1.5, 0.05, 0.1), decay_deg=(40.0, 30.0, 60.0), level=(100.0, 0.1, 0.04), nugget=(0.2, 0.01, 0.01),
    profile=((0.5, 0.1, -0.2), (-0.2, 0.0, 0.05), (0.2, 0.1, 0.0)), cell_deg=20.0, freedom=(4.0, 4.0, 4.0),
)  # fmt: skip


@pytest.mark.parametrize("decay_deg", [1.0, 40.0, 400.0])
def test_covariance_is_that_of_the_equation_and_positive_definite_without_a_nugget(decay_deg):
    prior = msgspec.structs.replace(KNOWN, nugget=(0.0,) * 3, decay_deg=(decay_deg,) * 3)
    for k in range(3):
        covariance = prior.covariance(k, np.concatenate([fibonacci_sphere(150), [[1, 0, 0], [-1, 0, 0], [0, 1, 0]]]))
        np.testing.assert_array_equal(covariance, covariance.T)
        assert np.linalg.eigvalsh(covariance).min() > 0
    directions = np.array([[1.0, 0, 0], [0, 1.0, 0], [-1.0, 0, 0]])
    half, quarter = 1.5 * np.exp(-180 / 40) + 100, 1.5 * np.exp(-90 / 40) + 100
    expected = [[101.7, quarter, half], [quarter, 101.7, quarter], [half, quarter, 101.7]]
    np.testing.assert_allclose(KNOWN.covariance(0, directions), expected, rtol=1e-12)


def test_all_frames_are_alike():
    directions, rotation = fibonacci_sphere(40), Rotation.random(random_state=3).as_matrix()
    np.testing.assert_allclose(KNOWN.precision(directions @ rotation.T)[0], KNOWN.precision(directions)[0], atol=1e-7)


def test_precision_is_the_inverse_of_the_covariance_of_log_radiance():
    directions = fibonacci_sphere(12)
    of_y = np.zeros((36, 36))
    for k in range(3):
        of_y[12 * k : 12 * k + 12, 12 * k : 12 * k + 12] = KNOWN.covariance(k, directions)
    unmix = np.kron(np.linalg.inv(MIX), np.eye(12))
    precision, log_determinant = KNOWN.precision(directions)
    np.testing.assert_allclose(precision @ unmix @ of_y @ unmix.T, np.eye(36), atol=1e-8)
    other, log_of_other = KNOWN.precision(directions, (2.0, 1.0, 0.5))  # a constant apart, the determinant's logarithm
    assert log_of_other - log_determinant == pytest.approx(
        np.linalg.slogdet(other)[1] - np.linalg.slogdet(precision)[1], abs=1e-9
    )


def test_the_shipped_table_reads_and_beats_its_nulls():
    prior = read_light_prior()
    assert len(prior.made_from) >= 30 and prior.level[0] == 100
    scores = prior.leave_one_out
    assert scores.prior > scores.white_noise and scores.prior > scores.no_profile
    assert np.linalg.eigvalsh(prior.precision(fibonacci_sphere(200))[0]).min() > 0
