"""The comparison: scores of the truth and of a grey ball, and scores by its steps."""

import numpy as np

from factorlib.conventions import lat_long_directions
from studies.baselines import (
    predict_by_projection,
    predict_by_rendering,
    predict_grey,
)
from studies.catalogue import methods as comparison
from studies.recovery_errors import in_gauge, scale_reflectance
from studies.run import data_of
from studies.spheres import materials_of, photograph
from studies.steps import compare, solve
from studies.study import Comparison, full_matrix
from tests.studies.test_run import TINY, concluded


def light(seed, rows=32):
    """An even sky with a few coloured lamps, mean radiance about 1."""
    rng = np.random.default_rng(seed)
    directions, sky = lat_long_directions(rows, 2 * rows), np.full((rows, 2 * rows, 3), 0.4)
    for axis in rng.normal(size=(4, 3)):
        colour, cosine = rng.uniform(0.5, 4, 3), directions @ (axis / np.linalg.norm(axis))
        sky += colour * np.exp(rng.uniform(5, 60) * (cosine - 1))[..., None]
    return sky


def case(side=3, size=24, seed=0):
    """All of so many materials in as many lights."""
    return Comparison(seed, tuple(full_matrix(side, side)), size)


def lights(seed, count=4):
    return {li: light(100 * seed + li) for li in range(count)}


def photos(**how):
    of = case(**how)
    return photograph(of, materials_of(of.seed), lights(of.seed))[0]


# ── scores ───────────────────────────────────────────────────────────────────────────────────────────────────────────


def scores(prediction):
    truths, maps = materials_of(0), lights(0, 3)
    pictures = compare.predict(case(side=2, size=12), truths, maps, prediction(truths, maps))
    return compare.score_method(truths, maps, prediction(truths, maps), pictures), pictures


def test_the_truth_in_any_gauge_scores_nothing_a_grey_ball_does_and_what_is_not_stated_has_no_score():
    factor = np.array([0.5, 2.0, 1.5])

    def true(truths, maps):
        materials = {n: scale_reflectance(truths[n], factor) for n in ("brick", "leaf")}
        return predict_by_rendering(*in_gauge(materials, {li: maps[li] / factor for li in (0, 1)}, truths))

    score, pictures = scores(true)
    assert {picture.target.kind for picture in pictures} == set(compare.KINDS)
    assert len({picture.target for picture in pictures}) == len(pictures) == 8 + 2 + 6
    measures = [kind + suffix for kind in compare.KINDS for suffix in compare.SUFFIXES.values()]
    assert max(score.values[m] for m in (*measures, "mirror")) < 1e-6 and score.values["roughness"] == 0
    worse, _ = scores(lambda truths, maps: predict_grey(photos(side=2, size=12), truths))
    assert min(worse.values[m] for m in measures) > 0.02 and "roughness" not in worse.values
    score, _ = scores(lambda truths, maps: predict_by_projection(photos(side=2, size=12), {}))
    assert not {"diffuse", "mirror", "novel_material"} & score.values.keys() and "novel_view" in score.values


def test_from_worlds_to_scores(tmp_path, monkeypatch):
    """By its steps."""
    monkeypatch.setitem(comparison.SIZES, "quick", 12)
    table = concluded(tmp_path, "comparison", data_of(tmp_path / "comparison", TINY), TINY, [solve, compare])[0]
    cells = {row["name"]: {m: c["spread"]["mean"] for m, c in row["cells"].items()} for row in table["rows"]}
    assert list(cells) == ["ours", "projective", "grey"] and table["quick"]
    assert all({"novel_view", "novel_light", "processor"} <= of.keys() for of in cells.values())
    assert cells["ours"]["novel_view"] < cells["grey"]["novel_view"] and "novel_material" not in cells["projective"]
