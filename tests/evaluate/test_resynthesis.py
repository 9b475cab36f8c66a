"""What counts, what is left out and said, and the flat null."""

import numpy as np
import pytest

from factorlib.evaluate.resynthesis import compare_photos, flat_materials, shot_of

SHAPE = (20, 30)


@pytest.fixture
def channels():
    """Two materials side by side, every normal facing the camera."""
    rng = np.random.default_rng(5)
    one, none = np.ones(SHAPE), np.zeros(SHAPE)
    label = np.where(np.arange(SHAPE[1]) < 15, 1.0, 2.0) * one
    photo = {c: rng.uniform(0.2, 0.8, SHAPE) for c in "RGB"} | {
        "label": label,
        "valid": one.copy(),
        "left_out": none.copy(),
    }
    photo |= {f"clipped.{c}": none.copy() for c in "RGB"}
    vector = {f"{kind}.{a}": (-one if a == "z" else none) for kind in ("normal", "view") for a in "xyz"}
    return photo, vector | {"label": label.copy(), "confidence": one}


def picture(photo):
    return np.stack([photo[c] for c in "RGB"], axis=-1)


def test_what_is_left_out_is_counted(channels):
    photo, geometry = channels
    photo["clipped.R"][0, :4] = 1
    photo["valid"][1, :3] = 0
    geometry["label"][2, :2] = 0
    geometry["confidence"][3, :7] = 0
    shot = shot_of(photo, geometry, picture(photo))
    assert shot.counts == {"pixels": 600 - 9, "unused": 7, "clipped": 4, "invalid": 3, "uncovered": 2}


def test_clipped_pixels_are_bounds(channels):
    photo, geometry = channels
    photo["clipped.R"][0, :4] = 1
    brighter, darker = picture(photo) * 1.5, picture(photo) * 0.5
    assert shot_of(photo, geometry, brighter).clipped_satisfied == 1.0
    assert shot_of(photo, geometry, darker).clipped_satisfied == 0.0


def test_neither_clipped_nor_invalid_pixels_touch_the_score(channels):
    photo, geometry = channels
    estimate = picture(photo) * 0.9
    photo["clipped.G"][3, 3], photo["valid"][4, 4] = 1, 0
    spoiled = estimate.copy()
    spoiled[3, 3], spoiled[4, 4] = 1e3, np.nan
    a, b = (compare_photos(["p"], ["m", "n"], lambda _, e=e: shot_of(photo, geometry, e)) for e in (estimate, spoiled))
    assert a.photos["p"].gauges == b.photos["p"].gauges


def test_gauges_and_the_flat_null(channels):
    photo, geometry = channels
    found = compare_photos(["p"], ["m", "n"], lambda _: shot_of(photo, geometry, 0.5 * picture(photo)))
    gauges = found.photos["p"].gauges
    assert gauges["none"].estimate.psnr_linear_db < 15 < 119 < gauges["scalar_per_set"].estimate.psnr_linear_db
    assert found.photos["p"].factor["channel_per_photo"] == pytest.approx((2, 2, 2))
    shot = shot_of(photo, geometry, picture(photo))
    flat = compare_photos(["p"], ["m", "n"], lambda _: shot_of(photo, geometry, flat_materials(shot))).photos["p"]
    assert flat.gauges["none"].estimate == flat.gauges["none"].null


def test_a_photo_that_shows_nothing_has_no_score(channels):
    photo, geometry = channels
    geometry["label"][:] = 0
    found = compare_photos(["p"], ["m", "n"], lambda _: shot_of(photo, geometry, picture(photo)))
    assert found.photos["p"].gauges is None and found.mean is None and found.photos["p"].materials == {}
