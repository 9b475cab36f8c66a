"""The prior on natural light: what its covariance must be, and that a fit finds the prior from which maps were drawn."""

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from factorlib.errors import InputError
from factorlib.geometry.sphere import fibonacci_sphere
from factorlib.light.prior import MIX, LightPrior, read_light_prior
from factorlib.light.prior_fit import cell_means, fitted, log_cells, rounded

KNOWN = LightPrior(
    variance=(1.5, 0.05, 0.1), decay_deg=(40.0, 30.0, 60.0), level=(100.0, 0.1, 0.04), nugget=(0.2, 0.01, 0.01),
    profile=((0.5, 0.1, -0.2), (-0.2, 0.0, 0.05), (0.2, 0.1, 0.0)), cell_deg=20.0, freedom=(4.0, 4.0, 4.0),
)  # fmt: skip
UP = np.array([0.0, 1.0, 0.0])


def drawn(prior: LightPrior, cells, count: int):
    """y of `count` maps, each of its own contrast."""
    rng = np.random.default_rng(0)

    def one(k, mean):
        contrast = np.sqrt(prior.freedom[k] / rng.chisquare(prior.freedom[k], (count, 1)))
        return contrast * rng.normal(size=(count, len(cells))) @ np.linalg.cholesky(prior.covariance(k, cells)).T + mean

    return np.stack([one(k, mean) for k, mean in enumerate(prior.mean(cells, UP))])


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


def test_without_up_all_frames_are_alike_and_with_up_the_profile_turns_along_and_leaves_the_level_alone():
    directions, rotation = fibonacci_sphere(40), Rotation.random(random_state=3).as_matrix()
    turned = directions @ rotation.T
    np.testing.assert_allclose(KNOWN.precision(turned)[0], KNOWN.precision(directions)[0], atol=1e-7)
    assert not KNOWN.mean(turned, None).any()
    np.testing.assert_allclose(KNOWN.mean(turned, rotation @ UP), KNOWN.mean(directions, UP), atol=1e-12)
    np.testing.assert_allclose(KNOWN.mean(fibonacci_sphere(5000), np.array([0.6, 0.0, 0.8])).mean(axis=1), 0, atol=1e-3)


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
        np.linalg.slogdet(other)[1] - np.linalg.slogdet(precision)[1]
    )


def test_a_fit_finds_the_prior_that_maps_were_drawn_from():
    cells = fibonacci_sphere(100)
    found = fitted(drawn(KNOWN, cells, 150), cells)
    for name, rtol in (("variance", 0.25), ("decay_deg", 0.25), ("nugget", 0.3), ("level", 0.5), ("freedom", 0.4)):
        np.testing.assert_allclose(getattr(found, name), getattr(KNOWN, name), rtol=rtol)
    np.testing.assert_allclose(found.profile, KNOWN.profile, atol=0.15)


def test_cells_hold_the_energy_of_the_map_and_dark_ones_are_floored():
    cells = fibonacci_sphere(50)
    np.testing.assert_allclose(cell_means(np.full((32, 64, 3), 2.0), cells), 2.0)
    lamp = np.zeros((64, 128, 3))
    lamp[20, 40] = 1
    assert np.count_nonzero(cell_means(lamp, cells).sum(axis=1)) == 1
    with pytest.raises(ValueError, match="too few"):
        cell_means(np.ones((2, 4, 3)), cells)
    means = np.ones((1, 5, 3))
    means[0, 0] = 0
    assert np.isfinite(log_cells(means)).all() and log_cells(means)[0, 0, 0] == pytest.approx(np.log(0.8e-4))


def test_the_shipped_table_reads_and_beats_its_nulls():
    prior = read_light_prior()
    assert prior == rounded(prior) and len(prior.made_from) >= 30 and prior.level[0] == 100
    scores = prior.leave_one_out
    assert scores.prior > scores.white_noise and scores.prior > scores.no_profile
    assert np.linalg.eigvalsh(prior.precision(fibonacci_sphere(200))[0]).min() > 0


@pytest.mark.parametrize("text", ["", "[1]", '{"variance": [1, 2, 3]}', '{"varianse": 1}'])
def test_a_file_that_is_no_prior_says_so(tmp_path, text):
    (tmp_path / "table.json").write_text(text)
    with pytest.raises(InputError, match="table.json"):
        read_light_prior(tmp_path / "table.json")
