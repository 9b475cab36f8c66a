"""What `make logs` says of results: their cost, what they were made with, what they warned of."""

import platform
import re

import pytest

from factorlib.errors import InputError
from factorlib.runner import verbs
from tests.runner import toy
from tests.runner.toy import make_project, write


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


COST = r" +\d+\.\d s +\d+\.\d s processor +\d+ MB peak   {} on 1 core   \d{{4}}-\d\d-\d\d \d\d:\d\d UTC$"


def test_each_step_has_its_time_its_memory_and_what_it_was_made_with(project, capsys):
    said = logs(project, capsys)
    for step, threads in (
        ("upper/a", "1 thread"),
        ("count/b", "1 thread"),
        ("table", "1 thread"),
        ("total", "2 threads"),
    ):
        assert re.search("^" + step + COST.format(threads), said, re.M), said
    assert re.search(r"Python 3\.\d+\.\d+, \w+ \w+, msgspec \d", said) and re.search(r"filelock \d", said)
    assert "warning: a is odd" in said


def test_one_stage_and_one_photo(project, capsys):
    assert [line.split()[0] for line in logs(project, capsys, "upper").splitlines() if not line.startswith(" ")] == [
        "upper/a",
        "upper/b",
    ]
    said = logs(project, capsys, photo="b")
    assert "upper/b" in said and "count/b" in said and "upper/a" not in said and "total" not in said
    with pytest.raises(InputError, match="no step is of 'aa'") as caught:
        logs(project, capsys, photo="aa")
    assert "PHOTO" in str(caught.value)


def test_what_is_not_made_says_why_and_what_failed_where(project, capsys, tmp_path):
    assert re.search(
        r"^table +to run: parameter scale: 2 \(the default\) -> 3$",
        logs(project, capsys, "table", settings=["table.scale=3"]),
        re.M,
    )
    broken = toy.copy(project, tmp_path / "broken")
    write(broken.root / "stages" / "table.py", toy.TABLE.replace("json.dumps(params.scale)", "json.dumps(1 / 0)"))
    assert verbs.make(broken, verbs.Wish("set")) == 1
    assert re.search(r"failed by a defect of the program: .*errors/table\.txt", logs(broken, capsys, "table"))


def test_no_log_names_the_machine(project):
    texts = [path.read_text() for path in (project.build / "store" / "logs").iterdir()]
    assert len(texts) == 6 and not any(platform.node() and f'"{platform.node()}"' in text for text in texts)
    assert not any(str(project.root) in text for text in texts)
