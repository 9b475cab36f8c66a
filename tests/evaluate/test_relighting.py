"""Relit balls: the truth is perfect, a wrong material shows in the true light, a wrong light only in the estimated one."""

import pytest

from factorlib.evaluate.ball import light_of_lat_long
from factorlib.evaluate.relighting import compare_relighting
from tests.evaluate.made_artifacts import TRUE as ALL
from tests.evaluate.made_artifacts import light_map

TRUE = {name: ALL[name] for name in ("red", "white")}
LIGHTS = {name: light_of_lat_long(light_map(seed)) for seed, name in enumerate("ab")}
SWAPPED = {"a": LIGHTS["b"], "b": LIGHTS["a"]}
SEEN = {"a": ["red"], "b": ["red", "white"]}


def test_the_truth_is_perfect_and_beats_its_nulls():
    found = compare_relighting(TRUE, TRUE, LIGHTS, LIGHTS, SEEN)
    for kinds in found.mean.values():
        assert kinds["in_true_light"].psnr_linear_db == kinds["in_estimated_light"].psnr_linear_db == 120
        assert kinds["null_grey"].psnr_tonemapped_db < 40 and kinds["null_mean_colour"].psnr_tonemapped_db < 40


def test_a_wrong_light_shows_only_in_the_estimated_light():
    kinds = compare_relighting(TRUE, TRUE, SWAPPED, LIGHTS, SEEN).mean["none"]
    assert kinds["in_true_light"].psnr_linear_db == 120 and kinds["in_estimated_light"].psnr_linear_db < 30


def test_pairs_that_no_photo_shows_are_told_apart():
    found = compare_relighting(TRUE, TRUE, LIGHTS, LIGHTS, SEEN)
    assert found.balls["a"]["red"].observed and not found.balls["a"]["white"].observed
    assert found.mean_unobserved is not None
    assert compare_relighting(TRUE, TRUE, LIGHTS, LIGHTS, dict.fromkeys(LIGHTS, tuple(TRUE))).mean_unobserved is None


@pytest.mark.parametrize("missing", ["materials", "lights"])
def test_without_a_pair_there_is_nothing(missing):
    assert (
        compare_relighting(
            TRUE, {} if missing == "materials" else TRUE, LIGHTS, {} if missing == "lights" else LIGHTS, {}
        )
        is None
    )
