"""The command line, one tiny study from worlds to the page, and a run that was killed."""

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
from studies.catalogue.contents import STUDIES
from studies.core.study import FULL, QUICK
from studies.core.table import Conclusion
from studies.report.page import page
from studies.run.project import data_of, studies
from studies.run.verbs import copy_pictures, forget, make
from studies.steps.spheres import conclude, observe, score, solve, worlds

SOLVE = {"solver": "few_lobes", "lobes": 4, "insert": 4, "rounds": 1, "iterations": 2, "polish": 1, "settle": 1}
TINY = msgspec.structs.replace(QUICK, largest=2, side=1, size=8, solve=SOLVE, light_rows=8, light_spp=1)
NAME = "matrix-size"


def cli(*words, **environment):
    return subprocess.run(
        [sys.executable, "-m", "studies", *words],
        cwd=LIBRARY,
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        check=False,
    )


def test_a_wrong_name_is_answered_with_the_right_one():
    done = cli("--one", STUDY="matrix-sise")
    assert done.returncode == 1 and "did you mean 'matrix-size'?" in done.stderr and "Traceback" not in done.stderr


def test_no_name_and_a_wrong_quick_are_said():
    assert "structure" in cli("--one", STUDY="").stderr
    assert "QUICK: 'yes' is neither 1 nor 0" in cli(QUICK="yes").stderr


def test_quick_results_lie_apart_from_full_ones(tmp_path):
    full, quick = (studies(scale, tmp_path).build for scale in (FULL, QUICK))
    assert full == tmp_path / "build/studies" and quick == tmp_path / "build/studies/quick"


def test_planning_needs_no_science():
    code = "import sys, studies.run.verbs; heavy = {'numpy', 'torch', 'scipy'} & set(sys.modules); sys.exit(', '.join(heavy) or 0)"
    done = subprocess.run([sys.executable, "-c", code], cwd=LIBRARY, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_a_change_of_the_scores_solves_nothing_again(tmp_path):
    """Neither what a study says nor how it is scored is in the key of a solve."""
    records = survey(studies(TINY, tmp_path), NAME, None, []).records
    solve_ = next(record for step, record in records.items() if step.stage == "solve")
    assert (
        "source:studies.core.case" in solve_
        and "source:stages.solve" in solve_
        and "source:factorlib.solve.solve" in solve_
    )
    assert (
        not {
            "source:studies.core.score",
            "source:studies.core.study",
            "source:studies.core.world",
            "source:studies.catalogue.matrix_size",
            "source:studies.report.figure",
        }
        & solve_.keys()
    )
    assert not any(
        "templates" in name or name.endswith("pipeline.yaml") for name in solve_ if name.startswith("data:studies")
    )


def solved(folder, name, data):
    """A case by its steps, without a runner."""
    facts = {f"dataset.{slice_}": data.slice(slice_, name).facts for slice_ in ("case", "worlds")}
    for stage, needs in ((observe, "worlds"), (solve, "observe"), (score, "solve")):
        out = folder / stage.__name__.rpartition(".")[2]
        out.mkdir(exist_ok=True)
        stage.main(
            stage.Params(), Inputs({"worlds": folder / "worlds", needs: folder / needs}, facts, photo=name), out, silent
        )


def test_a_tiny_study_from_worlds_to_the_page(tmp_path):
    data = data_of(tmp_path / NAME, msgspec.structs.replace(TINY, largest=1))
    (tmp_path / "worlds").mkdir()
    worlds.main(
        worlds.Params(), Inputs({}, {"dataset.worlds": data.slice("worlds", None).facts}), tmp_path / "worlds", silent
    )
    for name in data.photos:
        solved(tmp_path, name, data)
    gathered = {name: json.loads((tmp_path / "score" / f"{name}.json").read_text()) for name in data.photos}
    (tmp_path / "score/scores.json").write_text(json.dumps(gathered))
    (out := tmp_path / "conclude").mkdir()
    conclude.main(
        conclude.Params(),
        Inputs({"score": tmp_path / "score"}, {"dataset.study": data.slice("study", None).facts}),
        out,
        silent,
    )
    found = json.loads((out / "table.json").read_text())
    assert [row["label"] for row in found["rows"]] == ["1 × 1"] and found["label"] and not found["claims"]
    assert all(0 < row["cells"]["entries"]["spread"]["mean"] < 0.5 for row in found["rows"])
    figure = (out / "figure.svg").read_text()
    assert figure.startswith("<svg") and "no conclusion" in figure and "materials × lights" in figure
    text = page([(found, out)])
    assert "no conclusion" in text and "http" not in text.replace("http://www.w3.org/2000/svg", ""), (
        "the page stands alone"
    )


def test_the_page_heads_a_column_with_its_unit(tmp_path):
    found = Conclusion("x", "title", "?", "p", "v", "full", "", (0,), ("seconds", "entries"), [], [])
    (tmp_path / "figure.svg").write_text("<svg></svg>")
    text = page([(json.loads(msgspec.json.encode(found)), tmp_path)])
    assert "of a solve (s)</th>" in text and "<th>DSSIM, all entries</th>" in text


def test_the_page_escapes_what_it_shows(tmp_path):
    found = Conclusion("x", "<script>", "?", "&", "v", "full", "", (0,), ("entries",), [], [])
    (tmp_path / "figure.svg").write_text("<svg></svg>")
    assert "<script>" not in page([(json.loads(msgspec.json.encode(found)), tmp_path)])


@pytest.mark.parametrize("change", [{"measures": ["entries", "gone"]}, {"rows": 1}])
def test_the_page_names_tables_of_another_version_and_shows_the_others(tmp_path, change):
    found = json.loads(
        msgspec.json.encode(Conclusion("x", "title", "?", "&", "v", "full", "", (0,), ("entries",), [], []))
    )
    for name in ("new", "old"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "figure.svg").write_text("<svg></svg>")
    text = page([(found, tmp_path / "new"), (found | change, tmp_path / "old")])
    assert text.count("<section") == 1 and "not shown: old." in text
    assert "not shown" not in page([(found, tmp_path / "new")])


def finished(project):
    """Steps that were done, by name, as often as they were."""
    path = project.build / NAME / "log.jsonl"
    events = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
    return [f"{e['stage']}/{e['photo']}" for e in events if e["event"] == "done"]


KILLED = """
import sys
from pathlib import Path
from tests.studies.test_run import NAME, TINY
from studies.run.project import studies
from studies.run.verbs import copy_pictures, forget, make
if __name__ == "__main__":
    sys.exit(make(studies(TINY, Path(sys.argv[1])), [NAME]))
"""


@pytest.mark.long
def test_a_killed_study_goes_on_from_there_and_ends_with_the_page(tmp_path):
    project = studies(TINY, tmp_path)
    (tmp_path / "run_it.py").write_text(KILLED)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(LIBRARY), str(LIBRARY / "tests")])}
    process = subprocess.Popen(
        [sys.executable, str(tmp_path / "run_it.py"), str(tmp_path)], env=environment, start_new_session=True
    )
    deadline = time.monotonic() + 300
    while not any(step.startswith("solve/") for step in finished(project)):
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.05)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    before = finished(project)
    assert make(project, [NAME]) == 0
    assert len(finished(project)) == len(set(finished(project))) and set(before) < set(finished(project)), (
        "what was done is done again"
    )
    for name in ("figure.svg", "table.csv", "table.json", "paragraph.md"):
        assert (project.build / NAME / name).read_bytes() == (project.build / NAME / "conclude" / name).read_bytes()
    text = (project.build / "index.html").read_text()
    assert "no conclusion" in text and STUDIES[NAME].title in text
    assert make(project, [NAME]) == 0 and len(finished(project)) == len(set(finished(project))), (
        "there was nothing to do"
    )
    forget(project, [NAME])
    assert sorted(path.name for path in project.build.iterdir()) == ["index.html", "store"]
    assert STUDIES[NAME].title not in (project.build / "index.html").read_text()


def test_to_forget_what_was_not_run_is_no_error(tmp_path, capsys):
    assert forget(studies(TINY, tmp_path), [NAME]) == 0
    assert "has no results" in capsys.readouterr().out


def test_a_run_takes_the_pictures_of_the_last_away(tmp_path):
    found, home = tmp_path / "found", tmp_path / "home"
    found.mkdir()
    (found / "a.png").write_bytes(b"a")
    copy_pictures(found, home)
    (found / "a.png").rename(found / "b.png")
    copy_pictures(found, home)
    assert [path.name for path in home.iterdir()] == ["b.png"]
