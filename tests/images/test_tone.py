import numpy as np
import pytest

from factorlib.images.tone import by_log_exponent, curve, inverse, slope

X = np.concatenate([[0.0, 1e-4], np.geomspace(0.01, 50, 40)])
EXPONENTS = [0.5, 0.8, 1.0, 1.3, 2.2]


@pytest.mark.parametrize("exponent", EXPONENTS)
def test_black_and_the_mean_stay_and_brighter_is_brighter(exponent):
    assert curve(np.array([0.0, 1.0]), exponent) == pytest.approx([0, 1], abs=1e-12)
    assert (np.diff(curve(X, exponent)) > 0).all()


def test_the_exponent_1_changes_nothing():
    np.testing.assert_allclose(curve(X, 1.0), X, atol=1e-12)


@pytest.mark.parametrize("exponent", EXPONENTS)
def test_the_inverse_is_one(exponent):
    np.testing.assert_allclose(inverse(curve(X, exponent), exponent), X, rtol=1e-9, atol=1e-12)
    assert inverse(np.array([-0.1]), exponent) == pytest.approx([0], abs=1e-12)


@pytest.mark.parametrize("exponent", EXPONENTS)
def test_slopes_are_the_finite_differences(exponent):
    h = 1e-6
    by_x = (curve(X + h, exponent) - curve(X - h, exponent)) / (2 * h)
    by_log = (curve(X, exponent * np.exp(h)) - curve(X, exponent * np.exp(-h))) / (2 * h)
    np.testing.assert_allclose(slope(X, exponent), by_x, rtol=1e-6)
    np.testing.assert_allclose(by_log_exponent(X, exponent), by_log, rtol=1e-6, atol=1e-8)
