"""Transfer functions and tone curves: reference values, inverses, slopes as finite differences, NaN."""

import numpy as np
import pytest

from factorlib.images.tone import by_log_exponent, curve, inverse, slope
from factorlib.images.transfer import gamma_decode, srgb_decode, srgb_encode

X = np.concatenate([[0.0, 1e-4], np.geomspace(0.01, 50, 40)])


def test_srgb_reference_values():
    # 0.04045 / 12.92; ((0.5 + 0.055) / 1.055)^2.4; code 118 of 255 is the 18 % grey card
    assert srgb_decode(np.array([0.0, 0.04045, 0.5, 1.0])) == pytest.approx([0.0, 0.0031308, 0.2140411, 1.0], abs=1e-7)
    assert srgb_decode(np.array([118 / 255]))[0] == pytest.approx(0.18, abs=2e-3)
    assert srgb_encode(np.array([0.0031308, 0.18])) == pytest.approx([0.04045, 0.4613561], abs=1e-6)


def test_inverse_on_and_beyond_the_unit_interval():
    values = np.linspace(-0.5, 4, 1001)
    assert srgb_encode(srgb_decode(values)) == pytest.approx(values, abs=1e-6)
    assert srgb_decode(srgb_encode(values)) == pytest.approx(values, abs=1e-6)
    assert gamma_decode(np.copysign(np.abs(values) ** (1 / 2.2), values)) == pytest.approx(values, abs=1e-6)


@pytest.mark.parametrize("exponent", [0.5, 0.8, 1.0, 1.3, 2.2])
def test_tone_keeps_black_and_the_mean_is_inverted_and_its_slopes_are_the_finite_differences(exponent):
    assert curve(np.array([0.0, 1.0]), exponent) == pytest.approx([0, 1], abs=1e-12)
    assert (np.diff(curve(X, exponent)) > 0).all() and (exponent != 1 or np.allclose(curve(X, 1.0), X, atol=1e-12))
    np.testing.assert_allclose(inverse(curve(X, exponent), exponent), X, rtol=1e-9, atol=1e-12)
    assert inverse(np.array([-0.1]), exponent) == pytest.approx([0], abs=1e-12)
    h = 1e-6
    by_x = (curve(X + h, exponent) - curve(X - h, exponent)) / (2 * h)
    by_log = (curve(X, exponent * np.exp(h)) - curve(X, exponent * np.exp(-h))) / (2 * h)
    np.testing.assert_allclose(slope(X, exponent), by_x, rtol=1e-6)
    np.testing.assert_allclose(by_log_exponent(X, exponent), by_log, rtol=1e-6, atol=1e-8)
