"""Laws of PSNR, DSSIM and the tone map, and SSIM by its definition at one pixel."""

import numpy as np
import pytest

from factorlib.evaluate.picture import WINDOW, picture_error, picture_errors, psnr, ssim_map, tone_mapped, white_of


@pytest.fixture
def pictures():
    rng = np.random.default_rng(1)
    truth = rng.uniform(0, 1, (30, 40, 3))
    return truth, np.clip(truth + rng.normal(0, 0.05, truth.shape), 0, 1)


def test_psnr_by_hand():
    # an error of 0.1 everywhere against a peak of 1 is 10 log10(1 / 0.01) = 20 dB; of peak 10: 40 dB
    truth = np.ones((7, 3))
    assert psnr(truth - 0.1, truth, 1.0) == pytest.approx(20)
    assert psnr(truth - 0.1, truth, 10.0) == pytest.approx(40)


def test_the_same_picture_is_perfect_and_finite(pictures):
    truth, _ = pictures
    error = picture_error(truth, truth, np.ones(truth.shape[:2], bool), 1.0)
    assert (error.psnr_linear_db, error.psnr_tonemapped_db) == (120.0, 120.0)
    assert error.dssim == pytest.approx(0, abs=1e-6)


def test_ssim_is_its_definition_where_the_window_is_whole(pictures):
    a, b = pictures
    y, x, c = 15, 20, 1
    weight = np.outer(WINDOW, WINDOW)
    pa, pb = (p[y - 5 : y + 6, x - 5 : x + 6, c] for p in (a, b))
    ma, mb = (weight * pa).sum(), (weight * pb).sum()
    va, vb = (weight * (pa - ma) ** 2).sum(), (weight * (pb - mb) ** 2).sum()
    cov = (weight * (pa - ma) * (pb - mb)).sum()
    expected = (2 * ma * mb + 1e-4) * (2 * cov + 9e-4) / ((ma**2 + mb**2 + 1e-4) * (va + vb + 9e-4))
    grey_a, grey_b = (np.repeat(p[..., c : c + 1], 3, -1) for p in (a, b))
    found = ssim_map(grey_a, grey_b, np.ones(a.shape[:2], bool))[y, x]
    assert found == pytest.approx(expected, rel=1e-4)


def test_dssim_is_half_of_what_ssim_lacks():
    # black against white: both variances are 0, so SSIM = C1 / (1 + C1) = 1e-4 / 1.0001, and DSSIM is 0.49995
    black, white = np.zeros((12, 12, 3)), np.ones((12, 12, 3))
    assert picture_error(black, white, np.ones((12, 12), bool), 1.0).dssim == pytest.approx(0.49995, abs=1e-5)


def test_nothing_outside_the_mask_counts(pictures):
    truth, estimate = pictures
    mask = np.zeros(truth.shape[:2], bool)
    mask[5:20, 8:30] = True
    elsewhere = np.where(mask[..., None], estimate, 37.0)
    assert picture_error(elsewhere, truth, mask, 1.0) == picture_error(estimate, truth, mask, 1.0)


def test_scaling_both_pictures_and_the_white_changes_nothing(pictures):
    truth, estimate = pictures
    mask = np.ones(truth.shape[:2], bool)
    a = picture_error(estimate, truth, mask, white_of(truth, mask))
    b = picture_error(estimate * 8, truth * 8, mask, white_of(truth * 8, mask))
    assert a.psnr_linear_db == pytest.approx(b.psnr_linear_db) and a.dssim == pytest.approx(b.dssim, abs=1e-6)


def test_regions_are_scored_apart_and_empty_ones_left_out(pictures):
    truth, estimate = pictures
    left = np.zeros(truth.shape[:2], bool)
    left[:, :20] = True
    estimate = np.where(left[..., None], truth, estimate)
    found = picture_errors(estimate, truth, {"left": left, "right": ~left, "none": left & ~left}, 1.0)
    assert set(found) == {"left", "right"}
    assert found["left"].psnr_linear_db == 120 > found["right"].psnr_linear_db


def test_white_of_black_is_usable():
    black = np.zeros((4, 4, 3))
    assert white_of(black, np.ones((4, 4), bool)) == 1.0
    assert np.isfinite(tone_mapped(black, 1.0)).all()
