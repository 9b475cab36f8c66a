"""Errors of poses, normals, materials, lights, pictures and re-syntheses: by hand, blind to what the gauge allows, beside their nulls; and the balls that they are measured on."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from factorlib.conventions import lat_long_directions, lat_long_solid_angles
from factorlib.dataset.schema import RigidTransform
from factorlib.evaluate.ball import VIEW, OctahedralLight, diffuse_lobe, glossy_lobe, octahedral_light
from factorlib.evaluate.picture_errors import (
    WINDOW,
    combine_photo,
    picture_error,
    psnr,
    ssim_map,
    tone_map,
    white_level,
)
from factorlib.evaluate.relighting import compare_lights, compare_relighting, compare_relit_set, light_error, rgb_angle
from factorlib.evaluate.truth import albedo_errors, compare_materials, normal_error, pose_error
from factorlib.geometry.sphere import ball_normals
from factorlib.results.materials import Reflectance
from factorlib.results.metrics import RelativeError
from tests.evaluate.made_artifacts import TRUE, light_map, perturbed, scaled
from tests.evaluate.made_artifacts import TRUE as ALL
from tests.integral import reflected

# ── poses and normals ────────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("degrees", [0, 1e-3, 30, 90, 179])
def test_the_error_of_a_pose_is_its_turn_and_its_shift_over_the_true_distance(degrees):
    base = Rotation.random(rng=np.random.default_rng(0)).as_matrix()
    turn = Rotation.from_rotvec(np.radians(degrees) * np.array([0.6, 0.0, 0.8])).as_matrix()
    error = pose_error(RigidTransform(turn @ base, (0, 0, 4.4)), RigidTransform(base, (0, 0, 4.0)))
    assert error.rotation_deg == pytest.approx(degrees, abs=1e-5) and error.translation_relative == pytest.approx(0.1)


def test_normals_by_hand_and_only_where_both_are_known():
    truth = np.zeros((2, 2, 3))
    truth[..., 2] = -1.0
    estimate = truth.copy()
    estimate[0, 0], estimate[1, 1] = [0.0, np.sin(0.1), -np.cos(0.1)], 0.0
    result = normal_error(estimate, truth, np.ones((2, 2), bool))
    assert result.pixels == 3 and result.estimate.median_deg == 0
    assert result.estimate.p90_deg == pytest.approx(
        0.8 * np.degrees(0.1)
    )  # linear between the 2nd and the 3rd of three
    assert normal_error(estimate * 0, truth, np.ones((2, 2), bool)) is None


# ── materials ────────────────────────────────────────────────────────────────────────────────────────────────────────

ONE = dict.fromkeys(TRUE, 0)


def test_the_true_albedo_has_no_error_nor_has_it_times_a_factor_per_channel():
    truth, noise = np.random.default_rng(0).uniform(0.1, 0.9, (2, 500, 3))
    material = np.zeros(500, int)
    scores = albedo_errors([truth * [2.0, 0.5, 1.1], noise], truth, material, ["red", "wood"])
    assert scores.overall.estimate == RelativeError(0, 0) and scores.overall.null.median > 0.2
    assert scores.factor == pytest.approx((0.5, 2, 1 / 1.1)) and list(scores.materials) == ["red"]
    again = albedo_errors([noise * [3.0, 0.2, 1.0], noise], truth, material, ["red"])
    assert again.overall.estimate == again.overall.null == scores.overall.null


def test_a_known_error_of_albedo_is_that_number():
    """Of a hundred pixels a fifth are of wood, whose estimate is 30 % too bright; flat, a quarter is twice as dark."""
    truth = np.full((100, 3), 0.4)
    material = np.where(np.arange(100) < 20, 1, 0)
    kinds = [truth * factor[:, None] for factor in (1 + 0.3 * material, np.where(np.arange(100) < 75, 1, 0.5))]
    scores = albedo_errors(kinds, truth, material, ["red", "wood", "blue"])
    assert scores.overall.estimate == RelativeError(0, 0.3) and scores.overall.null == RelativeError(0, 0.5)
    assert scores.materials["wood"].estimate == RelativeError(0.3, 0.3) and scores.pixels == 100
    assert scores.materials["red"].estimate == RelativeError(0, 0) and "blue" not in scores.materials
    assert albedo_errors([each[:0] for each in kinds], truth[:0], material[:0], ["red"]) is None


def test_a_factor_per_channel_and_component_is_no_error():
    result = compare_materials({n: scaled(m, (2.0, 0.5, 3.0)) for n, m in TRUE.items()}, TRUE, ONE)
    assert result.factor["0"] == pytest.approx((0.5, 2.0, 1 / 3))
    assert result.worst_diffuse == pytest.approx(0, abs=1e-12) and result.worst_specular == pytest.approx(0, abs=1e-12)
    component = {"red": 0, "white": 0, "brass": 1, "black": 1}
    estimates = {n: scaled(m, 1.0 + component[n]) for n, m in TRUE.items()}
    assert compare_materials(estimates, TRUE, component).worst_diffuse == pytest.approx(0, abs=1e-12)
    assert compare_materials(estimates, TRUE, ONE).worst_diffuse > 0.2


def test_errors_are_the_perturbation_and_the_null_is_what_a_grey_ball_would_score():
    result = compare_materials({n: perturbed(m, 1.0) for n, m in TRUE.items()}, TRUE, ONE)
    # diffuse ×1.04, specular ×0.95: the common factor cannot take away the ratio 1.04 / 0.95
    red = result.materials["red"].error
    assert red.roughness == pytest.approx(0.02) and result.mean_diffuse < result.null_mean_diffuse
    assert (1 + red.diffuse[0]) / (1 + red.specular[0]) == pytest.approx(1.04 / 0.95)
    null = compare_materials(TRUE, TRUE, ONE).materials["black"].null
    # red channel: true diffuse + specular .56 .65 .55 .06, grey's .55: the median ratio is .555 / .55
    assert null.roughness == pytest.approx(0.3) and null.diffuse[0] == pytest.approx((0.5 * 0.555 / 0.55 - 0.02) / 0.02)
    assert null.specular[0] == pytest.approx((0.05 * 0.555 / 0.55 - 0.04) / 0.04)


def test_unseen_and_untold_materials_are_left_out_and_black_has_no_infinite_error():
    assert set(compare_materials(TRUE, TRUE, {"red": 0}).materials) == {"red"} and not compare_materials(TRUE, {}, ONE)
    estimate, truth = (Reflectance((0.5,) * 3, (specular, 0.0, 0.0), 0.5) for specular in (0.005, 0.0))
    result = compare_materials({"chalk": estimate}, {"chalk": truth}, {"chalk": 0})
    assert result.materials["chalk"].error.specular[0] == pytest.approx(0.5, rel=0.3)


# ── lights ───────────────────────────────────────────────────────────────────────────────────────────────────────────

MAPS = {"a": light_map(1), "b": light_map(2)}
TRUTHS = {name: octahedral_light(value) for name, value in MAPS.items()}


def compared(transform):
    estimates = {name: octahedral_light(transform(name, value)) for name, value in MAPS.items()}
    return compare_lights(estimates, TRUTHS, {})


def test_the_true_light_is_perfect_and_the_null_is_not():
    every = [scored for views in compared(lambda n, v: v).mean.values() for scored in views.values()]
    assert max(scored.estimate.rmse for scored in every) < 1e-6 and min(scored.null.rmse for scored in every) > 0.1


def test_gauges_forgive_what_they_name():
    tinted = compared(lambda n, v: v * ([2.0, 1.0, 0.5] if n == "a" else [1.0, 1.0, 1.0])).mean
    assert tinted["none"]["mirror"].estimate.rmse > 0.2
    assert tinted["scalar_per_set"]["mirror"].estimate.rmse > 0.1
    assert tinted["channel_per_photo"]["mirror"].estimate.rmse < 1e-6
    assert compared(lambda n, v: 3 * v).mean["scalar_per_set"]["mirror"].estimate.rmse < 1e-6


def test_light_error_by_hand_and_of_black():
    truth, turned = np.array([[1.0, 0, 0], [1.0, 0, 0]]), np.array([[0, 1.0, 0], [1.0, 0, 0]])
    assert rgb_angle(turned, truth) == pytest.approx(45)
    assert light_error(0.5 * truth, truth).rmse == pytest.approx(0.5)
    assert light_error(0.5 * truth, truth).rmse_scale_invariant == pytest.approx(0)
    scored = compared(lambda n, v: 0 * v).mean["channel_per_photo"]["mirror"].estimate
    assert (scored.rmse, scored.rgb_angle_deg) == (pytest.approx(1), 90)


# ── pictures ─────────────────────────────────────────────────────────────────────────────────────────────────────────


@pytest.fixture
def pictures():
    rng = np.random.default_rng(1)
    truth = rng.uniform(0, 1, (30, 40, 3))
    return truth, np.clip(truth + rng.normal(0, 0.05, truth.shape), 0, 1)


def test_psnr_and_dssim_by_hand(pictures):
    # an error of 0.1 everywhere against a peak of 1 is 10 log10(1 / 0.01) = 20 dB; of peak 10: 40 dB
    truth, whole = np.ones((7, 3)), np.ones((30, 40), bool)
    assert psnr(truth - 0.1, truth, 1.0) == pytest.approx(20) and psnr(truth - 0.1, truth, 10.0) == pytest.approx(40)
    # black against white: both variances are 0, so SSIM = C1 / (1 + C1) = 1e-4 / 1.0001, and DSSIM is 0.49995
    black = np.zeros((30, 40, 3))
    assert picture_error(black, black + 1, whole, 1.0).dssim == pytest.approx(0.49995, abs=1e-5)
    error = picture_error(pictures[0], pictures[0], whole, 1.0)
    assert error.psnr_linear_db == error.psnr_tonemapped_db == 120.0 and error.dssim == pytest.approx(0, abs=1e-6)
    assert white_level(black, whole) == 1.0 and np.isfinite(tone_map(black, 1.0)).all()


def test_ssim_is_its_definition_where_the_window_is_whole(pictures):
    y, x, c = 15, 20, 1
    weight = np.outer(WINDOW, WINDOW)
    pa, pb = (p[y - 5 : y + 6, x - 5 : x + 6, c] for p in pictures)
    ma, mb = (weight * pa).sum(), (weight * pb).sum()
    va, vb = (weight * (pa - ma) ** 2).sum(), (weight * (pb - mb) ** 2).sum()
    cov = (weight * (pa - ma) * (pb - mb)).sum()
    expected = (2 * ma * mb + 1e-4) * (2 * cov + 9e-4) / ((ma**2 + mb**2 + 1e-4) * (va + vb + 9e-4))
    grey = [np.repeat(p[..., c : c + 1], 3, -1) for p in pictures]
    assert ssim_map(*grey, np.ones((30, 40), bool))[y, x] == pytest.approx(expected, rel=1e-4)


# ── re-synthesis ─────────────────────────────────────────────────────────────────────────────────────────────────────


def test_what_is_left_out_is_counted_and_clipped_pixels_are_bounds():
    """Two materials side by side, every normal facing the camera; and the photo's radiance."""
    one, none, radiance = np.ones((20, 30)), np.zeros((20, 30)), np.random.default_rng(5).uniform(0.2, 0.8, (20, 30, 3))
    label = np.where(np.arange(30) < 15, 1.0, 2.0) * one
    photo = {c: radiance[..., k] for k, c in enumerate("RGB")} | {"label": label, "valid": one.copy(), "left_out": none}
    photo |= {f"clipped.{c}": none.copy() for c in "RGB"}
    vectors = {f"{kind}.{a}": (-one if a == "z" else none) for kind in ("normal", "view") for a in "xyz"}
    geometry = vectors | {"label": label.copy(), "confidence": one.copy()}
    photo["clipped.R"][0, :4], photo["valid"][1, :3] = 1, 0
    geometry["label"][2, :2], geometry["confidence"][3, :7] = 0, 0
    shot = combine_photo(photo, geometry, radiance)
    assert shot.counts == {"pixels": 600 - 9, "unused": 7, "clipped": 4, "invalid": 3, "uncovered": 2}
    satisfied = [combine_photo(photo, geometry, factor * radiance).clipped_satisfied for factor in (1.5, 0.5)]
    assert satisfied == [1.0, 0.0]


# ── The ball renderer against closed forms and against plain quadrature over every texel of the map ─────────────────


NORMALS, INSIDE = ball_normals(16)


def lobe_map(sharpness, height=128):
    axis = np.array([0.3, 0.8, 0.5]) / np.linalg.norm([0.3, 0.8, 0.5])
    value = np.exp(sharpness * (lat_long_directions(height, 2 * height) @ axis - 1))
    return value[..., None] * [1.0, 2.0, 3.0] + 0.1


def plain_quadrature(radiance, normals, diffuse, specular, roughness=0.5):
    """Of every texel of the map."""
    height, width = radiance.shape[:2]
    light = radiance * lat_long_solid_angles(height, width)[:, None, None]
    material, views = Reflectance((diffuse,) * 3, (specular,) * 3, roughness), np.tile(VIEW, (len(normals), 1))
    incoming = lat_long_directions(height, width).reshape(-1, 3)
    return reflected(material, normals, views, incoming, light.reshape(-1, 3))


@pytest.mark.parametrize("sharpness", [5, 60])
@pytest.mark.parametrize("roughness", [0.25, 0.9])
def test_the_glossy_ball_is_the_plain_quadrature(sharpness, roughness):
    radiance, some = lobe_map(sharpness), NORMALS[::9]
    expected = plain_quadrature(radiance, some, 0.0, 1.0, roughness)
    result = glossy_lobe(some, roughness)(octahedral_light(radiance))
    assert np.median(np.abs(result / expected - 1)) < 0.01
    assert np.abs(result - expected).max() < 0.03 * expected.max()


def test_the_matte_ball_is_the_plain_quadrature():
    radiance = lobe_map(20)
    expected = plain_quadrature(radiance, NORMALS, 1.0, 0.0)
    assert diffuse_lobe(NORMALS)(octahedral_light(radiance)) == pytest.approx(expected, rel=5e-3)


def test_the_viewer_sees_light_from_the_right_on_the_right():
    radiance = np.zeros((16, 32, 3))
    radiance[6:10, 7:9] = 1.0  # +x: a quarter of the width from the left edge
    picture = np.zeros(INSIDE.shape)
    picture[INSIDE] = diffuse_lobe(NORMALS)(octahedral_light(radiance))[:, 0]
    assert picture[:, 8:].sum() > 20 * picture[:, :8].sum()


# ── Relit balls and their score over the set: the truth is perfect, the gauge no error, and what is wrong shows where


PAIR = {name: ALL[name] for name in ("red", "brass")}
LIGHTS = {name: octahedral_light(light_map(seed)) for seed, name in enumerate("ab")}
SEEN = {"a": ["red"], "b": ["red", "brass"]}
WRONG = {n: perturbed(m, 3) for n, m in PAIR.items()}


def lit(factor):
    """The lights times a factor."""
    return {
        n: OctahedralLight(tuple(v * np.asarray(factor, v.dtype) for v in light.levels)) for n, light in LIGHTS.items()
    }


def test_the_truth_is_perfect_and_beats_its_nulls_and_unseen_pairs_are_told_apart():
    result = compare_relighting(PAIR, PAIR, LIGHTS, LIGHTS, SEEN)
    for kinds in result.mean.values():
        assert kinds["in_true_light"].psnr_linear_db == kinds["in_estimated_light"].psnr_linear_db == 120
        assert kinds["null_grey"].psnr_tonemapped_db < 40 and kinds["null_mean_colour"].psnr_tonemapped_db < 40
    assert result.balls["a"]["red"].observed and not result.balls["a"]["brass"].observed and result.mean_unobserved
    assert compare_relighting(PAIR, PAIR, LIGHTS, LIGHTS, dict.fromkeys(LIGHTS, tuple(PAIR))).mean_unobserved is None
    scored = compare_relit_set(PAIR, PAIR, LIGHTS, LIGHTS)
    assert scored.mean_psnr_db == scored.worst_psnr_db == 120 and scored.pairs == 4 and scored.factor == (1, 1, 1)
    assert 10 < scored.null_mean_psnr_db < 30


def test_a_factor_between_materials_and_lights_changes_nothing_but_itself_and_an_exposure_is_none():
    factor = np.array([2.0, 0.5, 3.0])
    materials, lights = {n: scaled(m, factor) for n, m in WRONG.items()}, lit(1 / factor)
    plain, result = compare_relit_set(WRONG, PAIR, LIGHTS, LIGHTS), compare_relit_set(materials, PAIR, lights, LIGHTS)
    assert result.factor == pytest.approx(tuple(np.array(plain.factor) / factor), rel=1e-6)
    scores = [(f.mean_psnr_db, f.worst_psnr_db, f.null_mean_psnr_db) for f in (result, plain)]
    assert scores[0] == pytest.approx(scores[1], abs=1e-3) and result.worst_material == plain.worst_material
    assert compare_relit_set(PAIR, PAIR, lit(1.2), LIGHTS).mean_psnr_db < 35
