"""Averaging down, transfer functions and tone curves: means and votes, reference values, inverses, slopes."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from factorlib.images.boxes import box_mean
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


# ── averaging down ────────────────────────────────────────────────────────────────────────────────────────────────────


@settings(max_examples=30)
@given(st.floats(0, 1e6, width=32), st.integers(1, 6), st.integers(1, 5), st.integers(1, 5))
def test_the_mean_is_that_of_the_whole_and_a_constant_stays_what_it_is_to_the_last_bit(value, factor, rows, columns):
    shape = rows * factor, columns * factor
    radiance = np.random.default_rng(factor).exponential(1, (*shape, 3)).astype(np.float32)
    mean, some = box_mean(radiance, np.ones(shape, bool), factor)
    assert mean.shape == (rows, columns, 3) and mean.dtype == np.float32 and some.all()
    np.testing.assert_allclose(mean.mean((0, 1), dtype=float), radiance.mean((0, 1), dtype=float), rtol=1e-6)
    assert (
        box_mean(np.full((*shape, 3), value, np.float32), np.ones(shape, bool), factor)[0] == np.float32(value)
    ).all()
