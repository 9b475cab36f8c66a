"""Relit balls and their score over the set: the truth is perfect, the gauge no error, and what is wrong shows where it is wrong."""

import numpy as np
import pytest

from factorlib.evaluate.ball import OctahedralLight, octahedral_light
from factorlib.evaluate.relighting import compare_relighting, compare_relit_set
from tests.evaluate.made_artifacts import TRUE as ALL
from tests.evaluate.made_artifacts import light_map, perturbed, scaled

TRUE = {name: ALL[name] for name in ("red", "brass")}
LIGHTS = {name: octahedral_light(light_map(seed)) for seed, name in enumerate("ab")}
SEEN = {"a": ["red"], "b": ["red", "brass"]}
WRONG = {n: perturbed(m, 3) for n, m in TRUE.items()}


def lit(factor):
    """The lights times a factor."""
    return {
        n: OctahedralLight(tuple(v * np.asarray(factor, v.dtype) for v in light.levels)) for n, light in LIGHTS.items()
    }


def test_the_truth_is_perfect_and_beats_its_nulls_and_unseen_pairs_are_told_apart():
    found = compare_relighting(TRUE, TRUE, LIGHTS, LIGHTS, SEEN)
    for kinds in found.mean.values():
        assert kinds["in_true_light"].psnr_linear_db == kinds["in_estimated_light"].psnr_linear_db == 120
        assert kinds["null_grey"].psnr_tonemapped_db < 40 and kinds["null_mean_colour"].psnr_tonemapped_db < 40
    assert found.balls["a"]["red"].observed and not found.balls["a"]["brass"].observed and found.mean_unobserved
    assert compare_relighting(TRUE, TRUE, LIGHTS, LIGHTS, dict.fromkeys(LIGHTS, tuple(TRUE))).mean_unobserved is None
    scored = compare_relit_set(TRUE, TRUE, LIGHTS, LIGHTS)
    assert scored.mean_psnr_db == scored.worst_psnr_db == 120 and scored.pairs == 4 and scored.factor == (1, 1, 1)
    assert 10 < scored.null_mean_psnr_db < 30


def test_a_factor_between_materials_and_lights_changes_nothing_but_itself_and_an_exposure_is_none():
    factor = np.array([2.0, 0.5, 3.0])
    materials, lights = {n: scaled(m, factor) for n, m in WRONG.items()}, lit(1 / factor)
    plain, found = compare_relit_set(WRONG, TRUE, LIGHTS, LIGHTS), compare_relit_set(materials, TRUE, lights, LIGHTS)
    assert found.factor == pytest.approx(tuple(np.array(plain.factor) / factor), rel=1e-6)
    scores = [(f.mean_psnr_db, f.worst_psnr_db, f.null_mean_psnr_db) for f in (found, plain)]
    assert scores[0] == pytest.approx(scores[1], abs=1e-3) and found.worst_material == plain.worst_material
    assert compare_relit_set(TRUE, TRUE, lit(1.2), LIGHTS).mean_psnr_db < 35
