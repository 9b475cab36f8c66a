"""Results that ship with the source are taken where sources and parameters are theirs, and made where they are not."""

import json

import pytest

from factorlib.errors import InputError
from factorlib.runner import verbs
from factorlib.runner.filehash import hash_of_file
from factorlib.runner.shared import MADE_FROM
from tests.runner.test_run import make, new_runs
from tests.runner.toy import make_project, write


@pytest.fixture
def project(tmp_path):
    """The toy, whose stage `table` has shipped a result that no stage would make: 2 by itself, 7 as shipped."""
    project = make_project(tmp_path / "root")
    write(
        project.pipeline_file,
        project.pipeline_file.read_text().replace(
            "  table: {}", "  table: {shipped: {folder: stages/tables, made_by: [stages.table]}}"
        ),
    )
    assert make(project, targets=["table"]) == 0
    assert verbs.ship(project, "table", "set") == 0
    shipped = project.root / "stages" / "tables"
    (shipped / "table.json").write_text("7")
    stored = json.loads((shipped / MADE_FROM).read_text())
    stored["files"]["table.json"] = hash_of_file(shipped / "table.json")
    (shipped / MADE_FROM).write_text(json.dumps(stored))
    return project


def table(project) -> int:
    return json.loads((project.build / "set" / "table" / "table.json").read_text())


def test_the_shipped_result_is_taken_where_sources_and_parameters_are_its_own(project):
    assert "table" in new_runs(project)
    assert table(project) == 7


def test_force_makes_it_anew(project):
    assert make(project, targets=["table"], force=True) == 0
    assert table(project) == 2


def test_another_parameter_makes_it_anew(project):
    assert make(project, targets=["table"], settings=["table.scale=3"]) == 0
    assert table(project) == 3


def test_another_source_makes_it_anew(project):
    stage = project.root / "stages" / "table.py"
    write(stage, stage.read_text().replace("dumps(params.scale)", "dumps(params.scale + 10)"))
    assert make(project, targets=["table"]) == 0
    assert table(project) == 12


def test_a_shipped_file_that_was_changed_is_an_error(project, capsys):
    (project.root / "stages" / "tables" / "table.json").write_text("8")
    assert make(project, targets=["table"]) == 1
    assert "is not the file that was shipped" in capsys.readouterr().err


def test_what_does_not_ship_is_not_shipped(project):
    with pytest.raises(InputError, match="no result of 'total' ships"):
        verbs.ship(project, "total", "set")
