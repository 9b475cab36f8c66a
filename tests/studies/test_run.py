"""The command line, two tiny studies from worlds to the page, keys of its steps, and a run that was killed."""

import json
import os
import subprocess
import sys

import msgspec
import numpy as np
import pytest

from factorlib.evaluate.ball import uniform_light
from factorlib.images.exr import LAT_LONG, write_rgb_exr
from factorlib.reflection.network import SHIPPED
from factorlib.results.materials import MaterialTable, StandardErrors, attach_errors
from factorlib.runner.dataset_state import Request, read_state
from factorlib.runner.project import LIBRARY
from factorlib.stage import Inputs, silent
from studies.catalogue import STUDIES
from studies.catalogue import methods as comparison
from studies.run import data_of, studies
from studies.run.tables import write_study
from studies.spheres import materials_of, observe_spheres
from studies.steps import compare, parts, rendered_sets, score, solve, worlds
from studies.study import QUICK, Case, Objects, World, full_matrix
from tests.stages.made import ran

TINY = msgspec.structs.replace(QUICK, largest=2, side=1, size=8, light_rows=8, light_spp=1)
NAME = "matrix-size"


@pytest.mark.parametrize(
    "words, environment, said",
    [
        (["--one"], {"STUDY": "matrix-sise"}, "did you mean 'matrix-size'?"),
        (["--one"], {"STUDY": ""}, "structure"),
        ([], {"QUICK": "yes"}, "QUICK: 'yes' is neither 1 nor 0"),
    ],
)
def test_wrong_names_and_words_are_answered(words, environment, said):
    command, environment = [sys.executable, "-m", "studies", *words], {**os.environ, **environment}
    process = subprocess.run(command, cwd=LIBRARY, env=environment, capture_output=True, text=True, check=False)
    assert process.returncode == 1 and said in process.stderr and "Traceback" not in process.stderr


@pytest.mark.parametrize(
    "name, step, there, absent",
    [
        (
            NAME,
            "solve",
            ["stages.solve", "factorlib.inference.joint_solver"],
            ["recovery_errors", "steps.score", "catalogue.matrices"],
        ),
        ("comparison", "solve", ["stages.solve"], ["steps.compare", "baselines"]),
    ],
)
def test_a_change_of_the_scores_or_the_claims_solves_nothing_again(tmp_path, name, step, there, absent):
    """Neither what a study says nor how it is scored is in the key of a solve."""
    records = read_state(studies(TINY, tmp_path), Request(name, list(STUDIES[name].steps))).records
    record = next(record for key, record in records.items() if key.stage == step)
    assert {f"source:{module}" for module in there} <= record.keys()
    assert not {f"source:studies.{module}" for module in absent} & record.keys()
    assert not any(field.endswith((".html", ".yaml")) for field in record if field.startswith("data:studies"))


def concluded(folder, name, data, scale, steps):
    """What a study comes to, worlds to conclusion, without a runner."""
    names = [step.__name__.rpartition(".")[2] for step in (worlds, *steps)]
    folders = {stage: folder / stage for stage in names}
    facts = {"dataset.worlds": data.slice("worlds", None).facts}
    ran(worlds, Inputs({}, facts), folder / "worlds", silent)
    for case in data.photos:
        given = Inputs(folders, facts | {"dataset.case": data.slice("case", case).facts}, photo=case)
        for stage, step in zip(names[1:], steps, strict=True):
            ran(step, given, folder / stage, silent)
    last = folder / names[-1]
    gathered = {case: json.loads((last / f"{case}.json").read_text()) for case in data.photos}
    (last / "scores.json").write_text(json.dumps(gathered))
    (home := folder / "build/studies/quick" / name).mkdir(parents=True)
    write_study(STUDIES[name], scale, last / "scores.json", home)
    return json.loads((home / "table.json").read_text()), home


def test_a_tiny_study_from_worlds_to_the_page(tmp_path):
    scale = msgspec.structs.replace(TINY, largest=1)
    table, home = concluded(tmp_path, NAME, data_of(tmp_path / NAME, scale), scale, [solve, score])
    assert [row["label"] for row in table["rows"]] == ["1 × 1"] and table["quick"] and not table["claims"]
    assert all(0 < row["cells"]["entries"]["spread"]["mean"] < 0.5 for row in table["rows"])
    text = (home / "paragraph.md").read_text()
    assert "no conclusion" in text and "| 1 × 1 |" in text


def test_a_tiny_comparison_from_worlds_to_its_table(tmp_path, monkeypatch):
    """By its steps."""
    monkeypatch.setitem(comparison.SIZES, "quick", 12)
    table = concluded(tmp_path, "comparison", data_of(tmp_path / "comparison", TINY), TINY, [solve, compare])[0]
    cells = {row["name"]: {m: c["spread"]["mean"] for m, c in row["cells"].items()} for row in table["rows"]}
    assert list(cells) == ["ours", "projective", "grey"] and table["quick"]
    assert all({"novel_view", "novel_light", "processor"} <= of.keys() for of in cells.values())
    assert cells["ours"]["novel_view"] < cells["grey"]["novel_view"] and "novel_material" not in cells["projective"]


# ── Cases: what they observe, of spheres and of objects, and their scores ──────────


LIGHTS = {li: uniform_light(np.array([1.0, 0.8, 0.5]) * (1 + li)) for li in range(3)}
RNG = np.random.default_rng(0)


def tables(entries, seed=0, **how):
    return observe_spheres(Case(seed, tuple(entries), 10, **how), materials_of(0), LIGHTS)


# ── spheres ──────────────────────────────────────────────────────────────────────────────────────────────────────────


def test_an_entry_is_the_same_whatever_else_a_case_shows_and_no_others_are_observed():
    pairs = {(p, t.materials[m]) for p, t in tables([(0, 0), (2, 0), (2, 1)]).items() for m in set(t.material.tolist())}
    assert pairs == {("light0", "brick"), ("light0", "lacquer"), ("light1", "lacquer")}
    small, large = tables([(1, 0)])["light0"], tables(full_matrix(3, 3))["light0"]
    assert np.array_equal(small.radiance, large.radiance[large.material == 1])
    other = tables([(1, 0)], seed=1)["light0"]  # its noise is of the seed
    assert not np.array_equal(small.radiance, other.radiance)
    assert small.radiance == pytest.approx(other.radiance, rel=0.1)


# ── objects ──────────────────────────────────────────────────────────────────────────────────────────────────────────


def test_a_case_from_lights_to_scores(tmp_path):
    """By its steps, without a runner: two photos."""
    how = {"cells": 24, "splittings": 0, "observations": 100}
    case, world = Case(0, ((0, 0), (0, 1)), 10, how, objects=Objects(60)), World((0,), 3, 8, 1)
    folders = {name: tmp_path / name for name in ("worlds", "solve", "score")}
    folders["worlds"].mkdir()
    for li in range(world.lights):
        write_rgb_exr(tmp_path / f"worlds/0-{li}.exr", RNG.uniform(0.5, 2, (8, 16, 3)).astype(np.float32), LAT_LONG)
    facts = {"dataset.case": msgspec.to_builtins(case), "dataset.worlds": msgspec.to_builtins(world)}
    for stage in (solve, score):
        name = stage.__name__.rpartition(".")[2]
        ran(stage, Inputs(folders, facts, photo="x"), folders[name], silent)
    values = json.loads((tmp_path / "score/x.json").read_text())["values"]
    assert values["seconds"] > 0 and values["normals"] == pytest.approx(0, abs=1e-3) and 0 <= values["new_light"] < 0.5


# ── scores ───────────────────────────────────────────────────────────────────────────────────────────────────────────

OF_TWO_COMPONENTS = pytest.mark.parametrize(
    "case",
    [  # two components each; objects with the two materials that spheres do not have
        Case(0, ((0, 0), (1, 0), (2, 1)), 10),
        Case(0, ((5, 0), (6, 0), (2, 1)), 10, objects=Objects(10)),
    ],
)
MAPS = {li: np.broadcast_to(np.array([1.0, 0.8, 0.5]) * (1 + li), (16, 32, 3)) for li in range(3)}
FACTORS = np.array([[0.5, 0.7, 0.9], [0.3, 0.9, 0.6]])


def scored(case, factors, roughness=0.0):
    """The truth, each component's materials times a factor per channel, its lights divided by it."""
    truths, of_light = materials_of(0, case.names), {0: factors[0], 1: factors[-1]}
    table = {}
    for m, li in case.entries:
        true, f = truths[case.names[m]], of_light[li]
        of = msgspec.structs.replace(
            true,
            diffuse=tuple(true.diffuse * f),
            specular=tuple(true.specular * f),
            roughness=true.roughness + roughness,
        )
        table[case.names[m]] = attach_errors(of, StandardErrors((0.01,) * 3, (0.01,) * 3, 0.02))
    own = {li: MAPS[li] / of_light[li] for li in case.lights}
    return score.score_case(case, truths, MAPS, MaterialTable(table).materials, own)


@OF_TWO_COMPONENTS
def test_the_truth_in_any_gauge_scores_nothing(case):
    result = scored(case, FACTORS)
    parts = {"entries", "observed", "unobserved", "new_light", "first_light"}
    parts |= {"first_material"} if 0 in case.materials else set()
    assert parts <= result.values.keys() and max(result.values[p] for p in (*parts, "diffuse", "mirror")) < 1e-5
    assert result.values["stated_roughness"] == pytest.approx(0.02) and "tint" not in result.values
    assert (
        min(result.nulls[p] for p in ("entries", "new_light")) > 1e-3
    )  # of constant lights, as these, all else is right


# ── rendered sets ────────────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.long
def test_a_rendered_set_is_observed_photo_by_photo_and_solved_without_a_part(tmp_path):
    sets = {"seeds": [0], "shots": 2, "width": 120, "height": 90, "spp": 4, "light_rows": 16}
    out = ran(rendered_sets, Inputs({}, {"dataset.sets": sets}), tmp_path / "sets", silent)
    assert len(list((out / "0" / "urm").glob("*.parquet"))) == len(list((out / "0" / "urm/background").iterdir())) == 2
    case = {"seed": 0, "change": "dropped", "solve": {"splittings": 0, "cells": 48, "interreflection": "off"}}
    inputs = Inputs({"rendered_sets": out, "train": SHIPPED}, {"dataset.case": case}, photo="bounce")
    scores = ran(parts, inputs, tmp_path / "scores", silent)
    for errors in json.loads((scores / "bounce.json").read_text("utf-8")).values():  # of the estimate, of the null
        assert np.isfinite([errors[name] for name in ("diffuse", "specular", "roughness", "mirror", "glossy")]).all()
