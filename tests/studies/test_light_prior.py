"""The fit of the prior on natural light: it finds the prior from which maps were drawn, and the command writes what it was made from."""

import hashlib

import msgspec
import numpy as np
import pytest
from scipy.optimize import approx_fprime

from factorlib.errors import InputError
from factorlib.geometry.sphere import fibonacci_sphere
from factorlib.images.exr import write_rgb_exr
from factorlib.jsonfile import read_json
from factorlib.light.prior import LightPrior, angles
from studies.measured import light_prior
from studies.measured.light_prior import _cost, cell_means, fitted, log_cells, maps_in, mean_of, rounded
from tests.light.test_prior import KNOWN


def drawn(prior: LightPrior, cells, count: int, seed: int = 0):
    """y of `count` maps, each of its own contrast."""
    rng = np.random.default_rng(seed)

    def one(k, mean):
        contrast = np.sqrt(prior.freedom[k] / rng.chisquare(prior.freedom[k], (count, 1)))
        return contrast * rng.normal(size=(count, len(cells))) @ np.linalg.cholesky(prior.covariance(k, cells)).T + mean

    return np.stack([one(k, mean) for k, mean in enumerate(mean_of(prior, cells))])


def test_a_fit_finds_the_prior_that_maps_were_drawn_from():
    cells = fibonacci_sphere(100)
    found = fitted(drawn(KNOWN, cells, 150), cells)
    for name, rtol in (("variance", 0.25), ("decay_deg", 0.25), ("nugget", 0.3), ("level", 0.5), ("freedom", 0.4)):
        np.testing.assert_allclose(getattr(found, name), getattr(KNOWN, name), rtol=rtol)
    np.testing.assert_allclose(found.profile, KNOWN.profile, atol=0.15)


def test_the_gradient_is_the_finite_difference():
    cells, t = fibonacci_sphere(30), np.log([0.5, 0.4, 0.3, 0.2, 3.0])
    design, values = np.ones((30, 1)), np.random.default_rng(0).standard_t(3, size=(6, 30))
    slope = approx_fprime(t, lambda t: _cost(t, angles(cells), design, values)[0], 1e-6)
    np.testing.assert_allclose(_cost(t, angles(cells), design, values)[1], slope, atol=1e-5)


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


def test_the_table_says_what_it_was_made_from_and_how_good_it_is(tmp_path, monkeypatch):
    """Of three maps, brighter above; a folder without any is named."""
    monkeypatch.setattr(light_prior, "CELLS", 25)
    rng, folder = np.random.default_rng(1), tmp_path / "maps"
    folder.mkdir()
    for name in "abc":
        logs = np.linspace(1, -1, 16)[:, None, None] + 0.5 * rng.normal(size=(16, 32, 3))
        write_rgb_exr(folder / f"{name}.exr", np.exp(logs))
    light_prior.main([folder], tmp_path / "table.json")
    prior = msgspec.convert(read_json(tmp_path / "table.json"), LightPrior)
    assert [source.name for source in prior.made_from] == ["a.exr", "b.exr", "c.exr"] and prior == rounded(prior)
    assert prior.made_from[0].sha256 == hashlib.sha256((folder / "a.exr").read_bytes()).hexdigest()
    assert prior.profile[0][0] > 0.5 and np.isfinite(prior.leave_one_out.prior)
    with pytest.raises(InputError, match="no .hdr or .exr"):
        maps_in([tmp_path])
