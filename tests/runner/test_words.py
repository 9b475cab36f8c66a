"""What `make logs` says of results, and `make params` of parameters."""

from __future__ import annotations

import importlib
import platform
import re
from typing import Annotated

import msgspec
import pytest

from factorlib.errors import InputError
from factorlib.runner import verbs
from factorlib.runner.pipeline import read_pipeline
from factorlib.runner.project import LIBRARY, Project, photo_sets
from factorlib.runner.words import parameters
from tests.runner import toy
from tests.runner.toy import make_project, write

COST = r" +\d+\.\d s +\d+\.\d s processor +\d+ MB peak   {} on 1 core   \d{{4}}-\d\d-\d\d \d\d:\d\d UTC$"


@pytest.fixture(scope="module")
def project(tmp_path_factory):
    made = make_project(tmp_path_factory.mktemp("toy") / "root", a="odd", b="Beta")
    write(made.root / "stages" / "table.py", toy.TABLE.replace("import json", "import json, filelock", 1))
    assert verbs.make(made, verbs.Wish("set")) == 0
    return made


def logs(project, capsys, *stages, photo=None, settings=()):
    capsys.readouterr()
    assert verbs.show_logs(project, verbs.Wish("set", list(stages) or None, list(settings)), photo) == 0
    return capsys.readouterr().out


def test_each_step_has_its_time_its_memory_and_what_it_was_made_with_and_no_log_names_the_machine(project, capsys):
    said = logs(project, capsys)
    for step, threads in (("upper/a", "1 thread"), ("count/b", "1 thread"), ("total", "2 threads")):
        assert re.search("^" + step + COST.format(threads), said, re.M), said
    assert re.search(r"Python 3\.\d+\.\d+, \w+ \w+, msgspec \d", said) and re.search(r"filelock \d", said)
    assert "warning: a is odd" in said
    texts = [path.read_text() for path in (project.build / "store" / "logs").iterdir()]
    hidden = [f'"{platform.node()}"', str(project.root)]
    assert len(texts) == 6 and not any(word in text for text in texts for word in hidden)


def test_one_stage_or_one_photo(project, capsys):
    steps = [line.split()[0] for line in logs(project, capsys, "upper").splitlines() if not line.startswith(" ")]
    assert steps == ["upper/a", "upper/b"]
    said = logs(project, capsys, photo="b")
    assert "upper/b" in said and "count/b" in said and "upper/a" not in said and "total" not in said
    with pytest.raises(InputError, match="no step is of 'aa'") as caught:
        logs(project, capsys, photo="aa")
    assert "PHOTO" in str(caught.value)


def test_what_is_not_made_says_why_and_what_failed_where(project, capsys, tmp_path):
    said = logs(project, capsys, "table", settings=["table.scale=3"])
    assert re.search(r"^table +to run: parameter scale: 2 \(the default\) -> 3$", said, re.M)
    broken = toy.copy(project, tmp_path / "broken")
    write(broken.root / "stages" / "table.py", toy.TABLE.replace("json.dumps(params.scale)", "json.dumps(1 / 0)"))
    assert verbs.make(broken, verbs.Wish("set")) == 1
    assert re.search(r"failed by a defect of the program: .*errors/table\.txt", logs(broken, capsys, "table"))


# ── parameters ───────────────────────────────────────────────────────────────────────────────────────────────────────


class Inner(msgspec.Struct, frozen=True):
    size: Annotated[int, msgspec.Meta(ge=1, le=9)] = 3
    """Of what
    is inside."""


class Base(msgspec.Struct):
    share: Annotated[float, msgspec.Meta(gt=0, lt=1)] = 0.5
    """A share."""


class Outer(Base):
    inner: Inner = Inner()
    mute: bool = False


def test_fields_of_bases_and_of_fields_are_there(capsys):
    expected = [
        ("share", "number > 0 and < 1", "0.5", "A share."),
        ("inner.size", "1 … 9", "3", "Of what is inside."),
        ("mute", "true, false", "false", ""),
    ]
    assert parameters(Outer) == expected
    assert verbs.show_params(Project(LIBRARY, photo_sets()), ["urm"]) == 0
    assert "urm.directions = 512    (0 … 4,096)\n    Directions of the sphere" in capsys.readouterr().out


@pytest.mark.parametrize("stage", read_pipeline(LIBRARY / "pipeline.yaml", photo_sets().slices).order())
def test_every_parameter_of_a_stage_says_what_it_means(stage):
    params = importlib.import_module(f"stages.{stage}").Params
    assert not [name for name, *_, text in parameters(params) if not text.endswith(".")]
