"""Damage in the store is noticed where a result is used, made again, named by `verify`; nothing is lost or spread."""

import json
import os
import shutil
from pathlib import Path

import pytest

from factorlib.runner import verbs
from factorlib.runner.gc import collect
from factorlib.runner.store import Inspector
from tests.faults.battered import make, new_runs, results
from tests.runner import toy
from tests.runner.toy import reasons, state, write


def current(project) -> dict[str, bytes]:
    return {name: data for name, data in results(project).items() if "log" not in name and "current" not in name}


def is_sound(project, dataset=None) -> bool:
    return verbs.verify(project, dataset) == 0


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


def link_elsewhere(path: Path) -> None:
    elsewhere = path.parent.parent / "elsewhere"
    path.rename(elsewhere)
    path.symlink_to(elsewhere)


def entries(project) -> list[dict]:
    return [json.loads(path.read_text()) for path in (project.build / "store" / "keys").glob("*.json")]


def tree_of(project, stage, file) -> Path:
    """The file of a stage's result where it lies in the store's trees."""
    trees = project.build / "store" / "trees"
    of = (e for e in entries(project) if e["record"]["stage"] == stage and file in e["files"])
    return trees / next(of)["output"] / file


def in_set(project, name) -> Path:
    """The file of a result where a user finds it."""
    stage, file = name.split("/")
    return (project.build / "set" / stage).resolve() / file


DAMAGES = {
    "other content": lambda path: overwrite(path, "OTHER"), "another file": lambda path: replace(path, "OTHER"),
    "one too many": lambda path: write(path.with_name("more.txt"), "1"), "cut": lambda path: os.truncate(path, 2),
    "missing": lambda path: path.unlink(), "a link": link_elsewhere,
    "all gone": lambda path: shutil.rmtree(path.parent),
}  # fmt: skip
OF_A_PHOTO, OF_THE_SET = ("upper", "a.txt", "upper/a"), ("total", "total.txt", "total")


@pytest.mark.parametrize("stage, file, step", [pytest.param(*OF_A_PHOTO, marks=pytest.mark.long), OF_THE_SET])
@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_result_is_made_again_and_nothing_else_is(project, damage, stage, file, step):
    before = current(project)
    DAMAGES[damage](tree_of(project, stage, file))
    assert state(project)[step] == "to run" and "damaged" in reasons(project, step)[0]
    assert {v for k, v in state(project).items() if k != step} <= {"current", "maybe"}
    assert new_runs(project) == [step] and current(project) == before
    assert new_runs(project) == [] and is_sound(project)


@pytest.mark.parametrize(
    "damage", [*list(DAMAGES)[:3], *(pytest.param(d, marks=pytest.mark.long) for d in list(DAMAGES)[3:])]
)
def test_what_a_user_does_to_a_file_under_the_datasets_name_is_noticed(project, damage):
    before = current(project)
    DAMAGES[damage](in_set(project, "upper/a.txt"))
    if damage != "all gone":
        DAMAGES[damage](in_set(project, "upper/sizes.json"))
    assert make(project) == 0
    assert current(project) == before and is_sound(project, "set")


def test_a_stage_over_the_set_reads_no_damaged_view(project):
    """The view alone is damaged: nothing is made again, for its tree is right, but the total is to read what is right."""
    replace(in_set(project, "count/counts.json"), '{"a": {"letters": 100}}')
    replace(in_set(project, "count/a.json"), '{"letters": 100}')
    assert new_runs(project, "table.scale=3") == ["table", "total"]
    assert in_set(project, "total/total.txt").read_text() == "total: 27"


def test_what_stood_in_the_place_of_a_result_is_kept_until_gc(project, capsys):
    overwrite(tree_of(project, "total", "total.txt"), "a user's own words")
    assert make(project) == 0
    text, damaged = capsys.readouterr().err, project.build / "store" / "damaged"
    assert "its kept result was damaged and is replaced" in text and "store/damaged/" in text
    assert [path.read_text() for path in damaged.rglob("total.txt")] == ["a user's own words"]
    collect(project)
    assert not list(damaged.iterdir())


def test_touched_copied_or_left_by_desktops_and_editors_is_no_damage(project, tmp_path):
    tree_of(project, "total", "total.txt").touch()
    assert set(state(project).values()) == {"current"}
    shutil.copytree(project.root, tmp_path / "copy", symlinks=True, copy_function=shutil.copyfile)
    assert set(state(toy.toy(tmp_path / "copy")).values()) == {"current"}
    for name in (".DS_Store", ".total.txt.swp", "total.txt~", ".ipynb_checkpoints/x"):
        for stage in ("total", "upper"):
            write((project.build / "set" / stage).resolve() / name, "1")
    assert new_runs(project) == [] and is_sound(project)


def test_damage_under_the_same_size_and_time_is_found_by_verify_or_replaced_by_force(project, capsys):
    before = current(project)
    overwrite(tree_of(project, "total", "total.txt"), "total: 19", keep_times=True)
    assert set(state(project).values()) == {"current"}, "size and time are those that were found right"
    assert verbs.verify(project, None) == 1
    text = capsys.readouterr().out
    assert "total (set)" in text and "total.txt: other content" in text and "build/store/trees" in text
    assert new_runs(project) == ["total"] and current(project) == before and is_sound(project)
    for stage, file in (("upper", "a.txt"), ("total", "total.txt")):
        path = tree_of(project, stage, file)
        overwrite(path, "X" * path.stat().st_size, keep_times=True)
    assert make(project, force=True) == 0
    assert current(project) == before and is_sound(project)


def test_a_tree_that_two_keys_share_is_made_once(project, capsys):
    shutil.copytree(project.root / "data" / "set", project.root / "data" / "again")
    write(project.root / "data" / "again" / "b.txt", "beta")  # another photo, the same words in capitals
    assert verbs.make(project, verbs.Wish("again")) == 0
    keys = [e for e in entries(project) if e["record"]["stage"] == "upper" and e["record"]["photo"] == "b"]
    assert len(keys) == 2 and len({e["output"] for e in keys}) == 1
    overwrite(tree_of(project, "upper", "b.txt"), "OTHER")
    assert verbs.verify(project, None) == 1
    text = capsys.readouterr().out
    assert "upper/b (set)" in text and "upper/b (again)" in text
    assert new_runs(project) == ["upper/b"]
    assert set(state(project, "again").values()) == {"current"} and is_sound(project)
    assert (project.build / "again" / "upper" / "b.txt").read_text() == "BETA"


def test_verify_names_views_keys_and_results_that_are_not_current(project, capsys):
    replace(in_set(project, "upper/sizes.json"), "{}")
    replace(in_set(project, "count/a.json"), "{}")
    next((project.build / "store" / "keys").glob("*.json")).write_text("{")
    assert verbs.verify(project, "set") == 1
    text = capsys.readouterr().out
    for words in ("upper (set)", "sizes.json: other content", "count (set)", "a.json: other content"):
        assert words in text
    assert "store/keys" in text and "not readable" in text
    assert make(project, "table.scale=3") == 0 and make(project) == 0 and is_sound(project, "set")
    overwrite(next(p for p in (project.build / "store" / "trees").rglob("table.json") if p.read_text() == "3"), "4")
    assert is_sound(project, "set") and not is_sound(project)
    assert "table (of an earlier run)" in capsys.readouterr().out


def spoiling(path, stage, before):
    """The text of a stage that spoils a file of the store just before some line of its own."""
    code = f"    p = __import__('pathlib').Path({str(path)!r}); p.chmod(0o644); p.write_text('{{\"letters\": 100}}')\n"
    return stage.replace(before, code + before, 1)


def test_damage_that_comes_while_a_run_goes_on_is_noticed_where_it_is_used(project, capsys):
    """The table spoils a result that the total reads after it; then the total one that it is reading itself."""
    path = project.build / "set" / "count" / "a.json"
    spoilt = spoiling(path, toy.TABLE, "    (out /").replace("params.scale)", "params.scale + 1)")
    write(project.root / "stages" / "table.py", spoilt)
    assert make(project) == 0 and is_sound(project)
    assert in_set(project, "total/total.txt").read_text() == "total: 27"
    write(project.root / "stages" / "total.py", spoiling(path, toy.TOTAL, "    counts ="))
    capsys.readouterr()
    assert make(project) == 1
    text = capsys.readouterr().err
    assert "a.json" in text and "changed while it was being read" in text and "defect" not in text


def test_a_disk_that_gives_back_something_else_does_not_loop(project, monkeypatch, capsys):
    wrong = lambda self, output, files: ["total.txt: other content"] if "total.txt" in files else []  # noqa: E731
    monkeypatch.setattr(Inspector, "damage", wrong)
    assert make(project) == 1
    assert "is the disk failing" in capsys.readouterr().err
