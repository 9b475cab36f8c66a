"""Halos of sharpening are found about masks; blur, soft shadows and plain edges have none."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from factorlib.images.processing import HALO, halo

H, W = 120, 160
Y, X = np.mgrid[:H, :W]
INSIDE = np.hypot(Y - 60, X - 80) < 35
KNOWN = np.ones((H, W), bool)


def picture(body, ground):
    """Linear radiance of a disc that shades away to its rim, before a ground with a gradient, from a camera with a little blur."""
    shaded = body * (1 - 0.4 * np.hypot(Y - 60, X - 80) / 35)
    return gaussian_filter(np.where(INSIDE, shaded, ground * (1 + X / W)), 0.7)


def sharpened(linear, sigma, amount):
    encoded = np.clip(linear, 0, 1) ** (1 / 2.2)
    return np.clip(encoded + amount * (encoded - gaussian_filter(encoded, sigma)), 0, 1) ** 2.2


def of(linear):
    return halo(np.repeat(linear[..., None], 3, axis=-1), INSIDE, KNOWN)


@pytest.mark.parametrize(("body", "ground"), [(0.6, 0.1), (0.08, 0.3)])
def test_sharpening_is_seen_and_what_cameras_and_scenes_do_is_not(body, ground):
    linear = picture(body, ground)
    assert of(linear) < HALO / 2
    assert of(sharpened(linear, 2.0, 1.0)) > HALO > of(gaussian_filter(linear, 1.5))
    near = np.hypot(Y - 60, X - 80) - 35
    contact = linear * np.where(near > 0, 1 - 0.3 * np.exp(-np.abs(near) / 6) * (Y > 60), 1)  # a shadow below
    assert of(contact) < HALO


def test_too_few_contours_and_pixels_that_are_left_out_say_nothing():
    linear = sharpened(picture(0.6, 0.1), 2.0, 1.0)
    of_three = np.repeat(linear[..., None], 3, axis=-1)
    assert halo(of_three, INSIDE, INSIDE) == 0
    assert halo(of_three, np.hypot(Y - 60, X - 80) < 4, KNOWN) == 0
