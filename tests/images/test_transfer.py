"""Transfer functions: reference values of IEC 61966-2-1, n-dimensional input, inverses, NaN."""

import numpy as np
import pytest

from factorlib.images.transfer import ENCODINGS, decoder, gamma_decode, gamma_encode, srgb_decode, srgb_encode

PAIRS = {"srgb": (srgb_decode, srgb_encode), "gamma2.2": (gamma_decode, gamma_encode)}


def test_srgb_reference_values():
    # 0.04045 / 12.92; ((0.5 + 0.055) / 1.055)^2.4; code 118 of 255 is the 18 % grey card
    assert srgb_decode(np.array([0.0, 0.04045, 0.5, 1.0])) == pytest.approx([0.0, 0.0031308, 0.2140411, 1.0], abs=1e-7)
    assert srgb_decode(np.array([118 / 255]))[0] == pytest.approx(0.18, abs=2e-3)
    assert srgb_encode(np.array([0.0031308, 0.18])) == pytest.approx([0.04045, 0.4613561], abs=1e-6)


@pytest.mark.parametrize("name", PAIRS)
def test_inverse_on_and_beyond_the_unit_interval(name):
    decode, encode = PAIRS[name]
    values = np.linspace(-0.5, 4, 1001)
    assert encode(decode(values)) == pytest.approx(values, abs=1e-6)
    assert decode(encode(values)) == pytest.approx(values, abs=1e-6)


@pytest.mark.parametrize("name", ENCODINGS)
def test_shape_type_and_order_are_kept(name):
    values = np.linspace(0, 1, 24, dtype=np.float32)
    flat = decoder(name)(values)
    assert flat.dtype == np.float32 and (np.diff(flat) > 0).all()
    np.testing.assert_array_equal(decoder(name)(values.reshape(2, 3, 4)), flat.reshape(2, 3, 4))


@pytest.mark.parametrize("name", ENCODINGS)
def test_nan_stays_nan_and_infinity_infinite(name):
    result = decoder(name)(np.array([np.nan, np.inf]))
    assert np.isnan(result[0]) and np.isinf(result[1])
