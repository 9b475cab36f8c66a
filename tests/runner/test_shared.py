"""A store that checkouts share: made once, copied by the others, and nobody's loss when it is damaged, read-only or gone."""

import json
import os
import shutil
import subprocess
import sys

import pytest

from factorlib.errors import InputError
from factorlib.runner import verbs
from factorlib.runner.gc import collect, forget_all
from factorlib.runner.project import LIBRARY
from factorlib.runner.store import Store
from tests.runner import toy
from tests.runner.toy import files_of, make_project, state, write

COUNTED = "    (Path(__file__).parents[1] / 'computed').open('a').write('x')\n    (out"


@pytest.fixture
def shared(tmp_path, monkeypatch):
    """An empty shared store."""
    folder = tmp_path / "shared"
    folder.mkdir()
    monkeypatch.setenv("FACTORLIB_STORE", str(folder))
    return folder


def checkout(folder, **texts):
    """A toy that counts how often it computes, in a file that is no part of it."""
    project = make_project(folder, **texts)
    for name, text in {"upper": toy.UPPER, "count": toy.COUNT, "table": toy.TABLE, "total": toy.TOTAL}.items():
        write(
            folder / "stages" / f"{name}.py",
            text.replace("import msgspec", "import msgspec\nfrom pathlib import Path", 1).replace(
                "    (out", COUNTED, 1
            ),
        )
    return project


def make(project, *settings, force=False):
    return verbs.make(project, verbs.Wish("set", None, list(settings), force))


def computed(project):
    """How many steps were computed here, ever."""
    file = project.root / "computed"
    return len(file.read_text()) if file.exists() else 0


def trees(store):
    return files_of(store / "trees")


def test_what_one_checkout_makes_the_other_copies(tmp_path, shared, capsys):
    one, other = checkout(tmp_path / "one"), checkout(tmp_path / "other")
    assert make(one) == 0 and computed(one) == 6
    assert trees(shared) == trees(one.build / "store") and trees(shared)
    verbs.show_plan(other, verbs.Wish("set"))
    assert "not made yet; the shared store has it" in capsys.readouterr().out
    assert make(other) == 0 and computed(other) == 0
    assert files_of(other.build / "set" / "total") == files_of(one.build / "set" / "total")
    assert set(state(other).values()) == {"current"} and verbs.verify(other, None) == 0
    assert len((other.build / "set" / "log.jsonl").read_text().splitlines()) == 6, "what it cost is known here too"


def test_both_give_and_take(tmp_path, shared):
    one, other = checkout(tmp_path / "one", a="Alpha", b="Beta"), checkout(tmp_path / "other", a="Alpha", c="Gamma")
    assert make(one) == 0 and make(other) == 0 and computed(other) == 3  # upper/c, count/c, total
    write(one.root / "data" / "set" / "c.txt", "Gamma")
    assert make(one) == 0 and computed(one) == 6 + 1  # total alone


def test_warnings_come_with_a_result(tmp_path, shared, capsys):
    assert make(checkout(tmp_path / "one", a="odd")) == 0
    capsys.readouterr()
    other = checkout(tmp_path / "other", a="odd")
    assert make(other) == 0 and computed(other) == 0 and "a is odd" in capsys.readouterr().err
    verbs.show_status(other, verbs.Wish("set"))
    assert "a is odd" in capsys.readouterr().out


def test_force_computes(tmp_path, shared):
    assert make(checkout(tmp_path / "one")) == 0
    other = checkout(tmp_path / "other")
    assert make(other, force=True) == 0 and computed(other) == 6


def test_without_the_variable_it_is_not_looked_at(tmp_path, shared, monkeypatch):
    assert make(checkout(tmp_path / "one")) == 0
    monkeypatch.delenv("FACTORLIB_STORE")
    other = checkout(tmp_path / "other")
    assert make(other) == 0 and computed(other) == 6


@pytest.mark.parametrize("damage", ["other content", "missing", "a link", "no tree"])
def test_a_damaged_result_is_made_here_and_mended_there(tmp_path, shared, capsys, damage):
    one, other = checkout(tmp_path / "one"), checkout(tmp_path / "other")
    assert make(one) == 0
    sound = trees(shared)
    file = next((shared / "trees").glob("*/table.json"))
    file.parent.chmod(0o755)
    file.unlink()
    if damage == "other content":
        file.write_text("7")
    elif damage == "a link":
        file.symlink_to(next((one.build / "store" / "trees").glob("*/table.json")))
    elif damage == "no tree":
        file.parent.rmdir()
    capsys.readouterr()
    assert (
        make(other) == 0
        and computed(other) == 1
        and "the shared store's result is not as it was kept" in capsys.readouterr().err
    )
    assert files_of(other.build / "set") == files_of(other.build / "set") and trees(other.build / "store") == sound
    assert trees(shared) == sound


@pytest.mark.parametrize("name", ["../../../../escaped", "/tmp/escaped", "a/../../../../../escaped"])
def test_a_forged_result_writes_nothing_outside(tmp_path, shared, name):
    one, other = checkout(tmp_path / "one"), checkout(tmp_path / "other")
    assert make(one) == 0
    for path in (shared / "keys").iterdir():
        entry = json.loads(path.read_text())
        files = {name: "0" * 32}
        path.chmod(0o644)
        path.write_text(json.dumps({**entry, "files": files, "output": _output(files)}))
    before = set(tmp_path.rglob("*escaped*"))
    assert make(other) == 0 and computed(other) == 6
    assert set(tmp_path.rglob("*escaped*")) == before and not os.path.exists("/tmp/escaped")


def _output(files):
    from factorlib.runner.store import output_of

    return output_of(files)


def test_a_record_of_another_key_is_not_taken(tmp_path, shared):
    one, other = checkout(tmp_path / "one"), checkout(tmp_path / "other")
    assert make(one, "table.scale=3") == 0
    of_stage = {json.loads(path.read_text())["record"]["stage"]: path for path in (shared / "keys").iterdir()}
    forged = next(
        p.key
        for p in __import__("factorlib.runner.survey", fromlist=["survey"]).survey(other, "set", None, []).planned()
        if p.step.stage == "table"
    )
    shutil.copyfile(of_stage["table"], shared / "keys" / f"{forged}.json")
    assert make(other) == 0 and (other.build / "set" / "table" / "table.json").read_text() == "2"


def test_one_that_vanishes_costs_nothing(tmp_path, shared, capsys):
    project = checkout(tmp_path / "one")
    text = (project.root / "stages" / "table.py").read_text()
    write(
        project.root / "stages" / "table.py",
        text.replace("    (out", "    import shutil, os; shutil.rmtree(os.environ['FACTORLIB_STORE'])\n    (out", 1),
    )
    assert make(project, "upper.sleep=0.5") == 0
    assert not shared.exists() and "the shared store took nothing (it is gone)" in capsys.readouterr().err
    assert (project.build / "set" / "total" / "total.txt").read_text() == "total: 18"


@pytest.mark.parametrize("there", ["nothing", "a file"])
def test_one_that_is_not_there_is_said_before_anything_runs(tmp_path, monkeypatch, there):
    if there == "a file":
        write(tmp_path / "shared", "")
    monkeypatch.setenv("FACTORLIB_STORE", str(tmp_path / "shared"))
    project = checkout(tmp_path / "one")
    for verb in (verbs.make, verbs.show_plan):
        with pytest.raises(InputError, match="no such folder") as caught:
            verb(project, verbs.Wish("set"))
        assert "FACTORLIB_STORE" in str(caught.value)
    assert computed(project) == 0


@pytest.mark.skipif(os.geteuid() == 0 and shutil.which("setpriv") is None, reason="root writes everywhere")
def test_one_that_may_only_be_read_is_read(tmp_path, shared):
    one, other = checkout(tmp_path / "one", a="Alpha"), checkout(tmp_path / "other", a="Alpha", b="Beta")
    assert make(one) == 0
    for folder in [shared, *(path for path in shared.rglob("*") if path.is_dir())]:
        folder.chmod(0o555)
    before = files_of(shared)
    drop = ["setpriv", "--bounding-set", "-dac_override,-dac_read_search"] if os.geteuid() == 0 else []
    command = [*drop, sys.executable, toy.__file__, str(other.root), "set"]
    done = subprocess.run(
        command, env={**os.environ, "PYTHONPATH": str(LIBRARY)}, capture_output=True, text=True, timeout=120
    )
    for folder in [shared, *(path for path in shared.rglob("*") if path.is_dir())]:
        folder.chmod(0o755)
    assert done.returncode == 0 and "warning" not in done.stderr, done.stderr
    assert computed(other) == 3 and files_of(shared) == before  # upper/b, count/b, total


def test_gc_and_clean_leave_it_alone(tmp_path, shared):
    one, other = checkout(tmp_path / "one"), checkout(tmp_path / "other")
    assert make(one) == 0 and make(one, "table.scale=3") == 0
    before = files_of(shared)
    collect(one)
    forget_all(one)
    assert files_of(shared) == before
    assert make(other) == 0 and computed(other) == 0


def test_a_store_of_ones_own_is_no_other(tmp_path, monkeypatch):
    project = checkout(tmp_path / "one")
    assert make(project) == 0
    monkeypatch.setenv("FACTORLIB_STORE", str(project.build / "store"))
    assert make(project, "table.scale=3") == 0 and verbs.verify(project, None) == 0
    assert len(list(Store(project.build / "store").keys.iterdir())) == 8
