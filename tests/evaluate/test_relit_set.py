"""The relit set score: the truth is perfect, the gauge is no error, a flat disc is the null, everything wrong costs."""

import math

import numpy as np
import pytest

from factorlib.evaluate.ball import Light, constant_light, light_of_lat_long
from factorlib.evaluate.relighting import Appearances, compare_relit_set, shown_psnr
from factorlib.results.materials import Reflectance
from tests.evaluate.made_artifacts import TRUE as ALL
from tests.evaluate.made_artifacts import light_map, perturbed

TRUE = {name: ALL[name] for name in ("red", "brass")}
LIGHTS = {name: light_of_lat_long(light_map(seed)) for seed, name in enumerate("ab")}
WRONG = {n: perturbed(m, 3) for n, m in TRUE.items()}
BLACK = Reflectance((0.0,) * 3, (0.0,) * 3, 0.5)


def times(material, factor):
    diffuse, specular = (
        tuple((np.array(colour) * factor).tolist()) for colour in (material.diffuse, material.specular)
    )
    return Reflectance(diffuse, specular, material.roughness)


def lit(light, factor):
    return Light(tuple(level * np.asarray(factor, level.dtype) for level in light.levels))


def gauged(factor):
    """WRONG times a factor, in the true lights over it."""
    return {n: times(m, factor) for n, m in WRONG.items()}, {n: lit(li, 1 / factor) for n, li in LIGHTS.items()}


def test_the_truth_is_perfect_and_beats_its_null():
    found = compare_relit_set(TRUE, TRUE, LIGHTS, LIGHTS)
    assert found.mean_psnr_db == found.worst_psnr_db == 120 and found.pairs == 4 and found.factor == (1, 1, 1)
    assert 10 < found.null_mean_psnr_db < 30


def test_a_factor_between_materials_and_lights_changes_nothing_but_itself():
    factor = np.array([2.0, 0.5, 3.0])
    materials, lights = gauged(factor)
    plain, found = compare_relit_set(WRONG, TRUE, LIGHTS, LIGHTS), compare_relit_set(materials, TRUE, lights, LIGHTS)
    assert found.factor == pytest.approx(tuple(np.array(plain.factor) / factor), rel=1e-6)
    scores = [(f.mean_psnr_db, f.worst_psnr_db, f.null_mean_psnr_db) for f in (found, plain)]
    assert scores[0] == pytest.approx(scores[1], abs=1e-3) and found.worst_material == plain.worst_material


def test_an_exposure_of_all_lights_is_no_gauge():
    assert compare_relit_set(TRUE, TRUE, {n: lit(li, 1.2) for n, li in LIGHTS.items()}, LIGHTS).mean_psnr_db < 35


def test_the_pair_is_shown_with_the_true_ball_at_half():
    true = np.full((5, 3), 7.0)  # shown as .5: 10 % more radiance is .5^(1/2.2) (1.1^(1/2.2) − 1) more
    assert shown_psnr(1.1 * true, true) == pytest.approx(
        -20 * math.log10(0.5 ** (1 / 2.2) * (1.1 ** (1 / 2.2) - 1)), abs=1e-5
    )


def test_a_disc_of_the_true_mean_colour_scores_the_null():
    red, grey = {"red": TRUE["red"]}, {"a": LIGHTS["a"]}
    colour = Appearances(LIGHTS["a"]).ball(TRUE["red"]).mean(axis=0)
    white, flat = (
        Reflectance((1.0,) * 3, (0.0,) * 3, 0.5),
        {"a": constant_light(colour)},
    )  # a white ball in constant light is a flat disc
    found = compare_relit_set({"red": white}, red, flat, grey)
    assert found.mean_psnr_db == pytest.approx(found.null_mean_psnr_db, abs=0.01)


@pytest.mark.parametrize("estimate", [BLACK, TRUE["red"]])
@pytest.mark.parametrize("truth", [BLACK, TRUE["red"]])
@pytest.mark.parametrize("estimated, true", [("dark", "a"), ("a", "dark"), ("dark", "dark"), ("a", "a")])
def test_black_materials_and_lights_give_numbers(estimate, truth, estimated, true):
    lights = {"a": LIGHTS["a"], "dark": constant_light(np.zeros(3))}
    found = compare_relit_set({"m": estimate}, {"m": truth}, {"l": lights[estimated]}, {"l": lights[true]})
    numbers = (found.mean_psnr_db, found.worst_psnr_db, found.null_mean_psnr_db, *found.factor)
    assert all(math.isfinite(v) for v in numbers) and found.factor == (1, 1, 1)


@pytest.mark.parametrize("missing", range(4))
def test_without_a_pair_there_is_nothing(missing):
    assert compare_relit_set(*({} if k == missing else of for k, of in enumerate((TRUE, TRUE, LIGHTS, LIGHTS)))) is None
