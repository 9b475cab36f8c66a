"""The command line, one tiny study from worlds to the page, keys of its steps, and a run that was killed."""

import json
import os
import signal
import subprocess
import sys
import time

import msgspec
import pytest

from factorlib.runner.project import LIBRARY
from factorlib.runner.survey import survey
from factorlib.stage import Inputs, silent
from studies.run import STUDIES, data_of, forget, make, studies
from studies.run.page import conclude, write_page
from studies.steps import score, solve, worlds
from studies.study import FULL, QUICK

SOLVE = {"solver": "few_lobes", "lobes": 4, "insert": 4, "rounds": 1, "iterations": 2, "polish": 1, "settle": 1}
TINY = msgspec.structs.replace(QUICK, largest=2, side=1, size=8, solve=SOLVE, light_rows=8, light_spp=1)
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
    done = subprocess.run(command, cwd=LIBRARY, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 1 and said in done.stderr and "Traceback" not in done.stderr


@pytest.mark.parametrize(
    "name, step, there, absent",
    [
        (NAME, "solve", ["stages.solve", "factorlib.solve.solve"], ["errors", "steps.score", "catalogue.matrix_size"]),
        ("comparison", "answer", ["stages.solve"], ["steps.compare", "methods"]),
    ],
)
def test_a_change_of_the_scores_or_the_claims_solves_nothing_again(tmp_path, name, step, there, absent):
    """Neither what a study says nor how it is scored is in the key of a solve."""
    records = survey(studies(TINY, tmp_path, name), name, list(STUDIES[name].steps), []).records
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
    conclude(STUDIES[name], scale, last, home)
    return json.loads((home / "table.json").read_text()), home


def test_a_tiny_study_from_worlds_to_the_page(tmp_path):
    scale = msgspec.structs.replace(TINY, largest=1)
    table, home = concluded(tmp_path, NAME, data_of(tmp_path / NAME, scale), scale, [solve, score])
    assert [row["label"] for row in table["rows"]] == ["1 × 1"] and table["quick"] and not table["claims"]
    assert all(0 < row["cells"]["entries"]["spread"]["mean"] < 0.5 for row in table["rows"])
    figure = (home / "figure.svg").read_text()
    assert figure.startswith("<svg") and "no conclusion" in figure and "materials × lights" in figure
    text = write_page(studies(scale, tmp_path)).read_text()
    assert "no conclusion" in text and "http" not in text.replace("http://www.w3.org/2000/svg", ""), "it stands alone"


def test_a_run_takes_the_pictures_of_the_last_away(tmp_path):
    study, home = (
        msgspec.structs.replace(STUDIES[NAME], settings=lambda s: [s.matrix(1, 1)], measures=()),
        tmp_path / "out",
    )
    (tmp_path / "scores.json").write_text('{"1x1-seed0": {"values": {}}}')
    (picture := tmp_path / "1x1-seed0.png").write_bytes(b"data")
    home.mkdir()
    conclude(study, QUICK, tmp_path, home)
    assert json.loads((home / "table.json").read_text())["pictures"] == {picture.name: "1 × 1, seed 0"}
    picture.unlink()
    conclude(study, QUICK, tmp_path, home)
    assert not (home / "pictures").exists()


def finished(project):
    """Steps that were done, by name, as often as they were."""
    path = project.build / NAME / "log.jsonl"
    events = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
    return [f"{e['stage']}/{e['photo']}" for e in events if e["event"] == "done"]


KILLED = """
import sys
from pathlib import Path
from tests.studies.test_run import NAME, TINY
from studies.run import make
if __name__ == "__main__":
    sys.exit(make(TINY, [NAME], root=Path(sys.argv[1])))
"""


@pytest.mark.long
def test_a_killed_study_goes_on_from_there_and_ends_with_the_page(tmp_path):
    project = studies(TINY, tmp_path)
    (tmp_path / "run_it.py").write_text(KILLED)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(LIBRARY), str(LIBRARY / "tests")])}
    command = [sys.executable, str(tmp_path / "run_it.py"), str(tmp_path)]
    process = subprocess.Popen(command, env=environment, start_new_session=True)
    deadline = time.monotonic() + 300
    while not any(step.startswith("solve/") for step in finished(project)):
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.05)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    before = finished(project)
    assert make(TINY, [NAME], root=tmp_path) == 0
    done = finished(project)
    assert len(done) == len(set(done)) and set(before) < set(done), "what was done is done again"
    assert STUDIES[NAME].title in (project.build / "index.html").read_text()
    assert make(TINY, [NAME], root=tmp_path) == 0 and finished(project) == done, "there was nothing to do"
    forget(TINY, [NAME], tmp_path)
    assert sorted(path.name for path in project.build.iterdir()) == ["index.html", "store"]
    assert STUDIES[NAME].title not in (project.build / "index.html").read_text()


def test_to_forget_what_was_not_run_is_no_error(tmp_path, capsys):
    assert forget(TINY, [NAME], tmp_path) == 0
    assert "has no results" in capsys.readouterr().out
    assert studies(QUICK, tmp_path).build == studies(FULL, tmp_path).build / "quick"
