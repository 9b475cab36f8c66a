"""Damage in the store: noticed where a result is used, made again, replaced by force, named by `verify`; nothing is lost or spread."""

import json
import os
import shutil
from pathlib import Path

import pytest

from factorlib.runner import verbs
from factorlib.runner.gc import collect
from tests.runner import toy
from tests.runner.test_run import new_runs
from tests.runner.toy import files_of, make_project, reasons, state, write


@pytest.fixture(scope="module")
def made_once(tmp_path_factory):
    made = make_project(tmp_path_factory.mktemp("toy") / "root")
    assert make(made) == 0
    return made


@pytest.fixture
def project(made_once, tmp_path):
    """The toy, everything current, in a folder of its own."""
    return toy.copy(made_once, tmp_path / "root")


def make(project, **options):
    settings = {"targets": None, "settings": [], "force": False} | options
    return verbs.make(project, verbs.Wish("set", **settings))


def shown(project) -> dict[str, bytes]:
    return {
        name: data
        for name, data in files_of(project.build / "set").items()
        if "log" not in name and "current" not in name
    }


def overwrite(path: Path, text: str, keep_times: bool = False) -> None:
    """In place, as an editor that writes into the file: every hard link to it changes."""
    stat = path.stat()
    path.chmod(0o644)
    with open(path, "r+") as stream:
        stream.truncate(0)
        stream.write(text)
    path.chmod(0o444)
    if keep_times:
        os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))


def replace(path: Path, text: str) -> None:
    """By rename, as `sed -i`: the other links keep the old content."""
    draft = path.with_name("draft")
    draft.write_text(text)
    os.replace(draft, path)


def tree_of(project, stage, file) -> Path:
    """The file of a stage's result where it lies in the store's trees."""
    return next(
        (project.build / "store" / "trees" / entry["output"] / file)
        for entry in entries(project)
        if entry["record"]["stage"] == stage and file in entry["files"]
    )


def entries(project) -> list[dict]:
    return [json.loads(path.read_text()) for path in (project.build / "store" / "keys").glob("*.json")]


DAMAGES = {
    "other content": lambda path: overwrite(path, "OTHER"),
    "another file": lambda path: replace(path, "OTHER"),
    "cut": lambda path: os.truncate(path, 2),
    "missing": lambda path: path.unlink(),
    "a link": lambda path: (
        path.rename(path.parent.parent / "elsewhere"),
        path.symlink_to(path.parent.parent / "elsewhere"),
    ),
    "one too many": lambda path: write(path.with_name("more.txt"), "1"),
    "all gone": lambda path: shutil.rmtree(path.parent),
}


OF_A_PHOTO, OF_THE_SET = ("upper", "a.txt", "upper/a"), ("total", "total.txt", "total")
QUICK = ("other content", "another file", "one too many")  # the rest go other ways to the same place


@pytest.mark.parametrize("stage, file, step", [pytest.param(*OF_A_PHOTO, marks=pytest.mark.long), OF_THE_SET])
@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_result_is_made_again_and_nothing_else_is(project, damage, stage, file, step, capsys):
    before = shown(project)
    DAMAGES[damage](tree_of(project, stage, file))
    assert state(project)[step] == "to run" and "damaged" in reasons(project, step)[0]
    assert {v for k, v in state(project).items() if k != step} <= {"current", "maybe"}
    assert new_runs(project) == [step]
    assert shown(project) == before
    assert new_runs(project) == [] and verbs.verify(project, None) == 0


@pytest.mark.parametrize(
    "damage", [name if name in QUICK else pytest.param(name, marks=pytest.mark.long) for name in DAMAGES]
)
def test_what_a_user_does_to_a_file_under_the_datasets_name_is_noticed(project, damage):
    before = shown(project)
    DAMAGES[damage]((project.build / "set" / "upper").resolve() / "a.txt")
    DAMAGES[damage]((project.build / "set" / "upper").resolve() / "sizes.json") if damage != "all gone" else None
    assert make(project) == 0
    assert shown(project) == before and verbs.verify(project, "set") == 0


def test_a_stage_over_the_set_reads_no_damaged_view(project):
    """The view alone is damaged: its tree is right, so that nothing is made again, but the total is to read what is right."""
    replace((project.build / "set" / "count").resolve() / "counts.json", '{"a": {"letters": 100}}')
    replace((project.build / "set" / "count").resolve() / "a.json", '{"letters": 100}')
    assert new_runs(project, settings=["table.scale=3"]) == ["table", "total"]
    assert (project.build / "set" / "total" / "total.txt").read_text() == "total: 27"


def test_what_stood_in_the_place_of_a_result_is_kept_until_gc(project, capsys):
    overwrite(tree_of(project, "total", "total.txt"), "a user's own words")
    assert make(project) == 0
    said = capsys.readouterr().err
    assert "its kept result was damaged and is replaced" in said and "store/damaged/" in said
    kept = list((project.build / "store" / "damaged").rglob("total.txt"))
    assert [path.read_text() for path in kept] == ["a user's own words"]
    collect(project)
    assert not list((project.build / "store" / "damaged").iterdir())


def test_touched_or_copied_and_not_changed_is_no_damage(project, tmp_path):
    tree_of(project, "total", "total.txt").touch()
    assert set(state(project).values()) == {"current"}
    shutil.copytree(project.root, tmp_path / "copy", symlinks=True, copy_function=shutil.copyfile)
    assert set(state(toy.toy(tmp_path / "copy")).values()) == {"current"}


@pytest.mark.parametrize("name", [".DS_Store", ".total.txt.swp", "total.txt~", ".ipynb_checkpoints/x"])
def test_what_desktops_and_editors_leave_is_no_damage(project, name):
    for stage in ("total", "upper"):
        write((project.build / "set" / stage).resolve() / name, "1")
    assert new_runs(project) == [] and verbs.verify(project, None) == 0


def test_a_byte_flipped_under_the_same_size_and_time_is_found_by_verify_and_then_made_again(project, capsys):
    before = shown(project)
    overwrite(tree_of(project, "total", "total.txt"), "total: 19", keep_times=True)
    assert set(state(project).values()) == {"current"}, "size and time are those that were found right"
    assert verbs.verify(project, None) == 1
    said = capsys.readouterr().out
    assert "total (set)" in said and "total.txt: other content" in said and "build/store/trees" in said
    assert new_runs(project) == ["total"] and shown(project) == before and verbs.verify(project, None) == 0


def test_force_replaces_a_damaged_result_even_under_the_same_size_and_time(project):
    before = shown(project)
    for stage, file in (("upper", "a.txt"), ("total", "total.txt")):
        path = tree_of(project, stage, file)
        overwrite(path, "X" * path.stat().st_size, keep_times=True)
    assert make(project, force=True) == 0
    assert shown(project) == before and verbs.verify(project, None) == 0


def test_a_tree_that_two_keys_share_is_made_once(project, capsys):
    shutil.copytree(project.root / "data" / "set", project.root / "data" / "again")
    write(project.root / "data" / "again" / "b.txt", "beta")  # another photo, the same words in capitals
    assert verbs.make(project, verbs.Wish("again")) == 0
    path = tree_of(project, "upper", "b.txt")
    keys = [e for e in entries(project) if e["record"]["stage"] == "upper" and e["record"]["photo"] == "b"]
    assert len(keys) == 2 and len({e["output"] for e in keys}) == 1
    overwrite(path, "OTHER")
    assert verbs.verify(project, None) == 1
    said = capsys.readouterr().out
    assert "upper/b (set)" in said and "upper/b (again)" in said
    assert new_runs(project) == ["upper/b"]
    assert set(state(project, "again").values()) == {"current"} and verbs.verify(project, None) == 0
    assert (project.build / "again" / "upper" / "b.txt").read_text() == "BETA"


def test_verify_names_a_view_and_a_key_that_are_damaged(project, capsys):
    replace((project.build / "set" / "upper").resolve() / "sizes.json", "{}")
    replace((project.build / "set" / "count").resolve() / "a.json", "{}")
    next((project.build / "store" / "keys").glob("*.json")).write_text("{")
    assert verbs.verify(project, "set") == 1
    said = capsys.readouterr().out
    assert (
        "build/set/upper" in said
        and "sizes.json: other content" in said
        and "build/set/count" in said
        and "a.json: other content" in said
    )
    assert "store/keys" in said and "not readable" in said
    assert make(project) == 0 and verbs.verify(project, "set") == 0


def test_verify_of_everything_reads_what_is_not_current_too(project, capsys):
    make(project, settings=["table.scale=3"])
    make(project)
    overwrite(next(p for p in (project.build / "store" / "trees").rglob("table.json") if p.read_text() == "3"), "4")
    assert verbs.verify(project, "set") == 0
    assert verbs.verify(project, None) == 1
    assert "table (of an earlier run)" in capsys.readouterr().out


def test_damage_that_comes_while_a_run_goes_on_is_noticed_where_it_is_used(project):
    """The table spoils a result that the total reads after it."""
    path = project.build / "set" / "count" / "a.json"
    code = f"    p = __import__('pathlib').Path({str(path)!r}); p.chmod(0o644); p.write_text('{{\"letters\": 100}}')\n    (out /"
    write(
        project.root / "stages" / "table.py",
        toy.TABLE.replace("    (out /", code).replace("params.scale)", "params.scale + 1)"),
    )
    assert make(project) == 0
    assert (project.build / "set" / "total" / "total.txt").read_text() == "total: 27"
    assert verbs.verify(project, None) == 0


def test_an_input_edited_while_it_is_read_gives_no_result(project, capsys):
    path = project.build / "set" / "count" / "a.json"
    code = f"    p = Path({str(path)!r}); p.chmod(0o644); p.write_text('{{\"letters\": 100}}')\n    counts ="
    write(project.root / "stages" / "total.py", toy.TOTAL.replace("    counts =", code))
    assert make(project) == 1
    said = capsys.readouterr().err
    assert "a.json" in said and "changed while it was being read" in said and "defect" not in said


def test_a_disk_that_gives_back_something_else_does_not_loop(project, monkeypatch, capsys):
    from factorlib.runner.store import Inspector

    monkeypatch.setattr(
        Inspector, "damage", lambda self, output, files: ["total.txt: other content"] if "total.txt" in files else []
    )
    assert make(project) == 1
    assert "is the disk failing" in capsys.readouterr().err
