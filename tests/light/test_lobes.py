"""Lobes: their integral, frames, and table."""

import numpy as np
import pytest
from scipy.integrate import quad

from factorlib.light.lobes import Lobes, lobe_integral, no_lobes
from factorlib.results.lobes import read_lobes, write_lobes


def some_lobes(count: int = 6, seed: int = 0) -> Lobes:
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=(count, 3))
    return Lobes(
        axis / np.linalg.norm(axis, axis=1, keepdims=True),
        np.geomspace(0.1, 5000, count),
        rng.uniform(0.1, 2, (count, 3)),
    )


@pytest.mark.parametrize("sharpness", [1e-6, 5e-4, 2e-3, 0.1, 3.0, 500.0])
def test_integral_is_the_quadrature_over_the_cosine(sharpness):
    expected = 2 * np.pi * quad(lambda t: np.exp(sharpness * (t - 1)), -1, 1)[0]
    assert lobe_integral(sharpness) == pytest.approx(expected, rel=1e-9)


def test_table_round_trip_is_exact_and_byte_equal(tmp_path):
    lights = {"b": some_lobes(3, 1), "dark": no_lobes(), "a": some_lobes(4, 2)}
    write_lobes(tmp_path / "1.parquet", lights)
    write_lobes(tmp_path / "2.parquet", dict(reversed(lights.items())))
    assert (tmp_path / "1.parquet").read_bytes() == (tmp_path / "2.parquet").read_bytes()
    found = read_lobes(tmp_path / "1.parquet")
    assert set(found) == set(lights)
    for name, lobes in lights.items():
        for field in ("axis", "sharpness", "weight"):
            np.testing.assert_array_equal(getattr(found[name], field), getattr(lobes, field))
