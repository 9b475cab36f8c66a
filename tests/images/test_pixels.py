"""Pixels: averaging down, transfer functions and tone curves, PNGs, and a lens's distortion."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from factorlib.dataset.schema import Intrinsics
from factorlib.images.colours import count_colours
from factorlib.images.grain import add_grain, grain_covariance
from factorlib.images.lens import Undistortion, radial_lens
from factorlib.images.photo import Photo, box_mean
from factorlib.images.picture import read_png, write_png
from factorlib.images.tone import by_log_exponent, curve, inverse, power_decode, slope, srgb_decode, srgb_encode
from tests.refusal import refusal

X = np.concatenate([[0.0, 1e-4], np.geomspace(0.01, 50, 40)])


def test_inverse_on_and_beyond_the_unit_interval():
    values = np.linspace(-0.5, 4, 1001)
    assert srgb_encode(srgb_decode(values)) == pytest.approx(values, abs=1e-6)
    assert srgb_decode(srgb_encode(values)) == pytest.approx(values, abs=1e-6)
    assert power_decode(2.2)(np.copysign(np.abs(values) ** (1 / 2.2), values)) == pytest.approx(values, abs=1e-6)


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


# ── Pictures for people: exposure, encoding, and PNGs that are the same bytes every time ────────────────────────────


RNG = np.random.default_rng(5)


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_a_png_keeps_colours_under_alpha_and_has_no_date(tmp_path, channels):
    pixels = RNG.integers(0, 256, (7, 5, channels), dtype=np.uint8)
    write_png(tmp_path / "a.png", pixels)
    np.testing.assert_array_equal(read_png(tmp_path / "a.png"), pixels)
    data = (tmp_path / "a.png").read_bytes()
    assert b"tIME" not in data and b"tEXt" not in data
    (tmp_path / "a.png").write_bytes(data[:8])
    refusal("a.png", read_png, tmp_path / "a.png")


# ── A lens's distortion is undone: against the picture that a pinhole takes of the same thing ───────────────────────


W, H = 90, 60
CAMERA = Intrinsics(focal_px=140.0, principal_point=(86.0, 64.0), distortion=(-0.2, 0.05))
LENS = radial_lens(CAMERA, 2, W, H)


def scene(points):
    """What a pinhole shows at image points: three smooth channels."""
    x, y = points[..., 0], points[..., 1]
    return np.stack([2 + np.sin(x / 9), 2 + np.cos(y / 7), 2 + np.sin((x + y) / 11)], axis=-1)


def pixels(height=H, width=W):
    return np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=-1)


def taken():
    """The photo that the lens takes of the scene; one pixel is clipped, another is no number."""
    radiance = scene(LENS.undistort(pixels().reshape(-1, 2)).reshape(H, W, 2)).astype("f4")
    clipped, finite = np.zeros((H, W, 3), bool), np.ones((H, W), bool)
    clipped[30, 40, 1], finite[20, 20] = True, False
    return Photo(radiance, clipped, finite, None, W, H, "linear")


def test_it_is_the_picture_of_a_pinhole_and_says_where_it_has_none():
    straight = Undistortion(LENS, H, W)
    photo = straight.photo(taken())
    assert np.abs(photo.radiance - scene(pixels()))[photo.finite].max() < 0.02
    assert np.abs(taken().radiance - scene(pixels())).max() > 0.3, "the lens is one that matters"
    (y, x), (v, u) = (np.argwhere(of).mean(0) + 0.5 for of in (photo.clipped[..., 1], straight.inside & ~photo.finite))
    np.testing.assert_allclose(LENS.distort(np.array([[x, y], [u, v]])), [[40.5, 30.5], [20.5, 20.5]], atol=0.6)
    barrel = radial_lens(Intrinsics(focal_px=140.0, distortion=(0.2, 0.0)), 2, W, H)
    edge = Undistortion(barrel, H, W)
    assert not edge.inside[0, 0] and edge.inside[H // 2, W // 2]
    assert not edge.resample_nearest(np.ones((H, W), bool))[~edge.inside].any()


def test_points_go_there_and_back_and_the_distortion_is_the_one_that_is_written_down():
    points = pixels()[::9, ::9].reshape(-1, 2)
    np.testing.assert_allclose(LENS.undistort(LENS.distort(points)), points, atol=1e-6)
    slopes = (points - [43.0, 32.0]) / 70.0
    r2 = np.square(slopes).sum(1, keepdims=True)
    np.testing.assert_allclose(LENS.distort(points), [43, 32] + 70 * slopes * (1 - 0.2 * r2 + 0.05 * r2**2))


def test_coefficients_of_no_lens_are_refused_and_no_distortion_is_no_lens():
    folded = radial_lens(Intrinsics(focal_px=140.0, distortion=(-3.0, 0.0)), 2, W, H)
    refusal("map two rays", folded.check, W, H, "dataset.yaml", "photos[a].camera.distortion")
    LENS.check(W, H, "dataset.yaml", "photos[a].camera.distortion")
    assert radial_lens(None, 1, W, H) is None and radial_lens(Intrinsics(focal_px=140.0), 1, W, H) is None


@pytest.mark.parametrize("other, share, colours", [
    ((0.5, 0.1, 0.1), 0.3, 1), ((0.1, 0.2, 0.5), 0.3, 2), ((0.1, 0.2, 0.5), 0.04, 1),
])  # fmt: skip
def test_shading_and_highlights_are_one_colour_and_paint_is_two(other, share, colours):
    draw = np.random.default_rng(1)
    paint = np.where(draw.random((4000, 1)) < share, other, (0.5, 0.1, 0.1))
    highlights = 0.6 * draw.random((4000, 1)) ** 8
    pixels = paint * draw.uniform(0.2, 1, (4000, 1)) * draw.lognormal(0, 0.1, (4000, 3)) + highlights
    assert count_colours(pixels) == colours


# ── Film grain: what is measured is the noise of the photo, and what is added is noise like it ──────────


DRAW = np.random.default_rng(3)
ROWS, COLUMNS = np.mgrid[:300, :400] / 400
SMOOTH = np.stack([0.2 + 0.5 * ROWS, 0.3 + 0.4 * COLUMNS, 0.5 + 0.2 * np.sin(9 * COLUMNS)], axis=-1)
SMOOTH[100:200:7, ::9] *= 0.6  # detail, which is no noise
MIX = np.array([[0.02, 0, 0], [0.015, 0.008, 0], [0.01, 0.0, 0.02]])  # channels that share a part of their noise


def noisy(scale: float) -> np.ndarray:
    """With a third of the photo beyond white, where noise is cut off."""
    encoded = SMOOTH + scale * DRAW.standard_normal(SMOOTH.shape) @ MIX.T
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
