"""Results of others: a store that checkouts share, and results that ship with the source."""

import json
import os
import shutil

import pytest

from factorlib.errors import InputError
from factorlib.runner import verbs
from factorlib.runner.plan import hash_of
from factorlib.runner.results_folder import clean, make_view, verify
from factorlib.runner.store import MADE_FROM, Store, hash_of_file
from tests.refusal import refusal
from tests.runner import toy
from tests.runner.toy import files_of, make, make_project, new_runs, state, write

COUNTED = "    (Path(__file__).parents[1] / 'computed').open('a').write('x')\n    (out"


@pytest.fixture
def shared(tmp_path, monkeypatch):
    """An empty shared store."""
    folder = tmp_path / "shared"
    folder.mkdir()
    monkeypatch.setenv("FACTORLIB_STORE", str(folder))
    return folder


@pytest.fixture
def one(tmp_path, shared):
    """A checkout that has made everything, and so has the shared store."""
    project = checkout(tmp_path / "one")
    assert make(project) == 0 and computed(project) == 6 and not (project.build / "store").exists()
    return project


def checkout(folder, **texts):
    """A toy that counts how often it computes, in a file that is no part of it."""
    project = make_project(folder, **texts)
    for name in ("upper", "count", "table", "total"):
        text = (folder / "stages" / f"{name}.py").read_text().replace("    (out", COUNTED, 1)
        write(folder / "stages" / f"{name}.py", "from pathlib import Path\n" + text)
    return project


def computed(project):
    """How many steps were computed here, ever."""
    file = project.root / "computed"
    return len(file.read_text()) if file.exists() else 0


def trees(store):
    """What steps made, without the views of it that each checkout makes itself."""
    entries = [json.loads(path.read_text()) for path in (store / "keys").iterdir()]
    return {e["output"]: files_of(store / "trees" / e["output"]) for e in entries if "view" not in e["record"]}


def test_what_one_checkout_makes_the_other_has(tmp_path, one, capsys):
    other = checkout(tmp_path / "other")
    verbs.show_plan(other, verbs.Request("set"))
    assert "all 6 steps are current" in capsys.readouterr().out
    assert make(other) == 0 and computed(other) == 0
    assert files_of(other.build / "set" / "total") == files_of(one.build / "set" / "total")
    assert set(state(other).values()) == {"current"} and verify(other, None) == 0


def test_clean_does_not_delete_what_others_need(tmp_path, one, shared):
    other, before = checkout(tmp_path / "other"), trees(shared)
    assert make(other) == 0 and clean(other, None) == 0
    assert trees(shared) == before and not (other.build / "set").exists()
    assert new_runs(one) == []


def test_a_forged_result_writes_nothing_outside(tmp_path, one, shared):
    names = ["../../../../escaped", "/tmp/escaped", "a/../../../../../escaped"]
    other, files = checkout(tmp_path / "other"), dict.fromkeys(names, "0" * 32)
    for number, path in enumerate(sorted((shared / "keys").iterdir())):
        entry, forged = json.loads(path.read_text()), dict([list(files.items())[number % 3]])
        path.chmod(0o644)
        path.write_text(json.dumps({**entry, "files": forged, "output": hash_of(forged)}))
    assert make(other) == 0 and computed(other) == 6
    assert not list(tmp_path.rglob("*escaped*")) and not os.path.exists("/tmp/escaped")


def test_a_record_of_another_key_is_not_taken(tmp_path, one, shared):
    assert make(one, "table.scale=3") == 0
    other = checkout(tmp_path / "other")
    key = next(p.key for p in toy.planned(other) if p.step.stage == "table")
    records = {path: json.loads(path.read_text())["record"] for path in (shared / "keys").iterdir()}
    forged = next(path for path, record in records.items() if record.get("param:scale") == 3)
    shutil.copyfile(forged, shared / "keys" / f"{key}.json")
    assert make(other) == 0 and (other.build / "set" / "table" / "table.json").read_text() == "2"


def test_one_that_is_not_there_is_said_before_anything_runs(tmp_path, monkeypatch):
    monkeypatch.setenv("FACTORLIB_STORE", str(tmp_path / "shared"))
    project = checkout(tmp_path / "one")
    for verb in (verbs.make, verbs.show_plan):
        with pytest.raises(InputError, match="no such folder") as caught:
            verb(project, verbs.Request("set"))
        assert "FACTORLIB_STORE" in str(caught.value)
        write(tmp_path / "shared", "")
    assert computed(project) == 0


# ── shipped with the source ──────────────────────────────────────────────────────────────────────────────────────────


@pytest.fixture
def shipping(tmp_path):
    """The toy, whose stage `table` has shipped a result that no stage would make: 2 by itself, 7 as shipped."""
    project = make_project(tmp_path / "root")
    shipped = "table: {shipped: {folder: stages/tables, made_by: [stages.table]}}"
    write(project.pipeline_file, toy.PIPELINE.replace("table: {}", shipped))
    assert make(project, targets=["table"]) == 0
    folder = project.root / "stages" / "tables"
    write(folder / "table.json", "7")
    stored = json.loads(next((project.build / "store" / "keys").iterdir()).read_text())
    stored["files"]["table.json"] = hash_of_file(folder / "table.json")
    (folder / MADE_FROM).write_text(json.dumps(stored))
    return project


@pytest.mark.parametrize(
    "settings, force, plus, expected",
    [([], False, 0, 7), ([], True, 0, 2), (["table.scale=3"], False, 0, 3), ([], False, 10, 12)],
    ids=["as shipped", "forced", "another parameter", "another source"],
)
def test_a_shipped_result_is_taken_where_sources_and_parameters_are_its_own(shipping, settings, force, plus, expected):
    if plus:
        text = toy.TABLE.replace("dumps(params.scale)", f"dumps(params.scale + {plus})")
        write(shipping.root / "stages" / "table.py", text)
    assert make(shipping, *settings, targets=["table"], force=force) == 0
    assert json.loads((shipping.build / "set" / "table" / "table.json").read_text()) == expected


def test_a_shipped_file_that_was_changed_is_an_error(shipping, capsys):
    folder = shipping.root / "stages" / "tables"
    (folder / "table.json").write_text("8")
    assert make(shipping, targets=["table"]) == 1
    assert "are not the files that were shipped" in capsys.readouterr().err
    stored = json.loads((folder / MADE_FROM).read_text())
    (folder / MADE_FROM).write_text(
        json.dumps(stored | {"files": {"../table.py": hash_of_file(folder / "table.json")}})
    )
    assert make(shipping, targets=["table"]) == 1, "a name that leads out of the folder"


def test_two_photos_with_one_file_name_are_refused_and_a_view_without_its_gathered_file_is_made_again(tmp_path):
    store = Store(tmp_path)
    for photo in ("a", "b"):
        write(store.trees / photo / f"{photo}.json", "{}")
        write(store.trees / f"{photo}-same" / "same.json", photo)
    store.tmp.mkdir(exist_ok=True)
    view = make_view(store, {"a": "a", "b": "b"}, "all.json")
    (view / "all.json").unlink()
    assert make_view(store, {"a": "a", "b": "b"}, "all.json") == view and (view / "all.json").is_file()
    refusal("'same.json'", make_view, store, {"a": "a-same", "b": "b-same"}, None)
    assert [(store.trees / f"{p}-same" / "same.json").read_text() for p in "ab"] == ["a", "b"]
