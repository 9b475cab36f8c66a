"""Film grain: what is measured is the noise of the photo, and what is added is noise like it."""

import numpy as np
import pytest

from factorlib.images.tone import srgb_decode, srgb_encode
from factorlib.render.recipe_pictures import add_grain, grain_covariance

RNG = np.random.default_rng(3)
ROWS, COLUMNS = np.mgrid[:300, :400] / 400
SMOOTH = np.stack([0.2 + 0.5 * ROWS, 0.3 + 0.4 * COLUMNS, 0.5 + 0.2 * np.sin(9 * COLUMNS)], axis=-1)
SMOOTH[100:200:7, ::9] *= 0.6  # detail, which is no noise
MIX = np.array([[0.02, 0, 0], [0.015, 0.008, 0], [0.01, 0.0, 0.02]])  # channels that share a part of their noise


def noisy(scale: float) -> np.ndarray:
    """With a third of the photo beyond white, where noise is cut off."""
    encoded = SMOOTH + scale * RNG.standard_normal(SMOOTH.shape) @ MIX.T
    return srgb_decode(np.where(COLUMNS[..., None] > 0.67, np.minimum(encoded + 0.5, 1), encoded))


@pytest.mark.parametrize("scale", [0.5, 1.0, 2.0])
def test_grain_has_the_covariance_of_the_photos_noise_and_its_measure_finds_it_again(scale):
    photo, flat = noisy(scale), np.full(SMOOTH.shape, srgb_decode(np.array(0.5)))
    expected = scale**2 * MIX @ MIX.T
    np.testing.assert_allclose(grain_covariance(photo), expected, rtol=0.1, atol=0.02 * expected.max())
    added = (srgb_encode(add_grain(flat, photo, np.ones(flat.shape[:2]))) - 0.5).reshape(-1, 3)
    np.testing.assert_allclose(np.cov(added.T), expected, rtol=0.1, atol=0.02 * expected.max())
    assert np.abs(added.mean(axis=0)).max() < 0.02 * np.sqrt(expected.max())


def test_grain_is_the_same_each_time_falls_with_its_weight_and_leaves_other_pixels_alone():
    photo, flat = noisy(1.0), np.full(SMOOTH.shape, 0.2)
    share = np.clip(2 * COLUMNS - 0.5, 0, 1)
    once, again = (add_grain(flat, photo, share) for _ in range(2))
    assert np.array_equal(once, again) and np.array_equal(once[share == 0], flat[share == 0])
    half, whole = (np.std(srgb_encode(once)[np.abs(share - weight) < 0.1]) for weight in (0.5, 1.0))
    assert half == pytest.approx(whole / 2, rel=0.1)
    assert add_grain(0 * flat, photo, share).min() == 0, "no light is negative"


def test_a_photo_without_noise_and_one_without_light_have_no_grain():
    for photo in (np.full((20, 20, 3), 0.3), np.zeros((20, 20, 3)), np.full((1, 9, 3), 0.3)):
        np.testing.assert_allclose(add_grain(np.full(photo.shape, 0.4), photo, np.ones(photo.shape[:2])), 0.4)
