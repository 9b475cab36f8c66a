"""The command line, two tiny studies from worlds to the page, keys of its steps, and a run that was killed."""

import json
import os
import subprocess
import sys

import msgspec
import pytest

from factorlib.runner.dataset_state import Request, read_state
from factorlib.runner.project import LIBRARY
from factorlib.stage import Inputs, silent
from studies.catalogue import STUDIES
from studies.catalogue import methods as comparison
from studies.run import data_of, studies
from studies.run.tables import write_study
from studies.steps import compare, score, solve, worlds
from studies.study import QUICK

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
    for stage in names:
        folders[stage].mkdir(exist_ok=True)
    facts = {"dataset.worlds": data.slice("worlds", None).facts}
    worlds.main(worlds.Params(), Inputs({}, facts), folder / "worlds", silent)
    for case in data.photos:
        given = Inputs(folders, facts | {"dataset.case": data.slice("case", case).facts}, photo=case)
        for stage, step in zip(names[1:], steps, strict=True):
            step.main(step.Params(), given, folder / stage, silent)
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
