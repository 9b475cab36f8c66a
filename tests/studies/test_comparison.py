"""The comparison: scores of the truth and of a grey ball, and scores by its steps."""

import os
import subprocess
import sys

import numpy as np
import pytest

from factorlib.conventions import lat_long_directions
from factorlib.evaluate.material_errors import compare_materials
from studies.body import photographed
from studies.catalogue import methods as comparison
from studies.errors import in_gauge, times
from studies.methods import (
    grey,
    intrinsic,
    lambertian_part,
    projective,
    rendered,
)
from studies.run import data_of
from studies.spheres import materials_of
from studies.steps import answer, compare
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


def case(side=3, size=24, seed=0, method="ours", steps=2):
    """All of so many materials in as many lights."""
    return Comparison(seed, tuple(full_matrix(side, side)), size, method=method, pixels=12, steps=steps)


def lights(seed, count=4):
    return {li: light(100 * seed + li) for li in range(count)}


def photos(**how):
    of = case(**how)
    return photographed(of, materials_of(of.seed), lights(of.seed))[0]


# ── methods ──────────────────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("seed", [200, 201])
def test_the_decompositions_albedo_beats_a_grey_one_on_truth(seed):
    """Else it would be no baseline."""
    truths = materials_of(seed)
    found = intrinsic(photos(seed=seed, size=32), truths).materials
    errors = compare_materials(found, lambertian_part(truths), dict.fromkeys(found, 0))
    assert errors.mean_diffuse < 0.8 * errors.null_mean_diffuse


# ── scores ───────────────────────────────────────────────────────────────────────────────────────────────────────────


def scores(prediction):
    world = compare.World(materials_of(0), lights(0, 3))
    taken = compare.shots(case(side=2, size=12), world, prediction(world))
    return compare.score_of(world, prediction(world), taken, 1.0), taken


def test_the_truth_in_any_gauge_scores_nothing_a_grey_ball_does_and_what_is_not_stated_has_no_score():
    factor = np.array([0.5, 2.0, 1.5])

    def true(world):
        materials = {n: times(world.materials[n], factor) for n in ("brick", "leaf")}
        return rendered(*in_gauge(materials, {li: world.lights[li] / factor for li in (0, 1)}, world.materials))

    score, taken = scores(true)
    assert {of.shot.kind for of in taken} == set(compare.KINDS)
    assert len({of.shot for of in taken}) == len(taken) == 8 + 2 + 6
    measures = [kind + suffix for kind in compare.KINDS for suffix in compare.SUFFIXES.values()]
    assert max(score.values[m] for m in (*measures, "mirror")) < 1e-6 and score.values["roughness"] == 0
    worse, _ = scores(lambda world: grey(photos(side=2, size=12), world.materials))
    assert min(worse.values[m] for m in measures) > 0.02 and "roughness" not in worse.values
    score, taken = scores(lambda world: projective(photos(side=2, size=12), {}))
    assert not {"diffuse", "mirror", "novel_material"} & score.values.keys() and "novel_view" in score.values


def test_from_worlds_to_pictures(tmp_path, monkeypatch):
    """By its steps, Mitsuba's two steps of a tiny optimisation in a process of their own included."""
    environment = {name: value for name, value in os.environ.items() if name != "FACTORLIB_MITSUBA"}
    words = [sys.executable, "-c", "from factorlib.tracing.variant import mitsuba; print(mitsuba().variant())"]
    if "llvm_ad_rgb" not in subprocess.run(words, env=environment, capture_output=True, text=True).stdout:
        pytest.skip("Mitsuba has no derivatives here: its joint optimisation needs LLVM")
    monkeypatch.setitem(comparison.SIZES, "quick", (12, 12, 2))
    table, out = concluded(tmp_path, "comparison", data_of(tmp_path / "comparison", TINY), TINY, [answer, compare])
    cells = {row["name"]: {m: c["spread"]["mean"] for m, c in row["cells"].items()} for row in table["rows"]}
    assert list(cells) == ["ours", "mitsuba", "intrinsic", "projective", "grey"] and table["quick"]
    assert all({"novel_view", "novel_light", "processor"} <= of.keys() for of in cells.values())
    assert cells["ours"]["novel_view"] < cells["grey"]["novel_view"] and "novel_material" not in cells["projective"]
    assert {path.stem for path in (out / "pictures").iterdir()} == {f"{method}-seed0" for method in cells}
