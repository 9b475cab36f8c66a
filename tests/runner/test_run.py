"""Real runs of a toy pipeline: what runs, what is kept, what is shown, what survives."""

import fcntl
import itertools
import json
import os
import re
import shutil
from functools import partial

import pytest

from factorlib.runner import display, verbs
from factorlib.runner.plan import Step, hash_of
from factorlib.runner.project import Pipeline, Stage, with_settings
from factorlib.runner.results_folder import clean, make_view, verify
from factorlib.runner.run_folder import begin_run, end_run
from factorlib.runner.store import MADE_FROM, Store, hash_of_file, is_locked, lock
from tests.faults.test_kills import start, wait_until
from tests.refusal import refusal
from tests.runner import toy
from tests.runner.toy import done, edit, files_of, make, make_project, new_runs, reasons, state, write

COST = r" +\d+\.\d s +\d+\.\d s processor +\d+ MB peak   {} on 1 core   \d{{4}}-\d\d-\d\d \d\d:\d\d UTC$"
WRITES = "json.dumps(params.scale)"  # what the table is, in its source


def total(project):
    return (project.build / "set" / "total" / "total.txt").read_text()


def table(project):
    return (project.build / "set" / "table" / "table.json").read_text()


def test_all_results_stand_under_the_datasets_name_read_only_and_their_costs_in_a_log(project, capsys):
    home = project.build / "set"
    assert total(project) == "total: 18"
    assert (home / "total" / "log.txt").read_text() == "5"  # upper and count of two photos, table
    assert json.loads((home / "upper" / "sizes.json").read_text()) == {"a": {"size": 5}, "b": {"size": 4}}
    assert sorted(p.name for p in (home / "upper").iterdir()) == ["a.json", "a.txt", "b.json", "b.txt", "sizes.json"]
    assert not list((project.build / "store" / "tmp").iterdir()), "something is left behind"
    files = [p for p in (project.build / "store" / "trees").rglob("*") if p.is_file()]
    assert files and not any(p.stat().st_mode & 0o222 for p in files)
    event = json.loads((home / "log.jsonl").read_text().splitlines()[0])
    assert event["seconds"] > 0 and event["memory_mb"] > 1 and event["threads"] == 1 and event["key"]
    assert new_runs(project) == [] and "nothing to do" in capsys.readouterr().out


# ── what a change reruns ─────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize(
    "file, text, step, reason, runs",
    [
        ("stages/upper.py", "# a remark\n" + toy.UPPER, "total", "", []),
        ("toylib/letters.py", toy.LETTERS.replace("How many", "How very many"), "total", "", []),
        ("toylib/letters.py", toy.LETTERS.replace("isalpha", "isupper"), "count/a", "source of toylib.letters: changed",
         ["count/a", "count/b"]),  # they come out the same, so total stays
        ("stages/templates/total.html", "in all: ", "total", "package data stages:templates/total.html: changed",
         ["count/a", "count/b", "table", "total", "upper/a", "upper/b"]),  # it lies beside every stage
        ("data/set/a.txt", "Alphabet", "upper/a", "file a.txt: changed", ["count/a", "total", "upper/a"]),
        ("data/set/a.txt", "alphA", "upper/a", "file a.txt: changed", ["upper/a"]),
        ("data/set/c.txt", "Gamma", "count/c", "not made yet", ["count/c", "total", "upper/c"]),
        ("data/set/a.txt", None, "total", "result of count/a: gone", ["total"]),
    ],
    ids=["a remark", "a docstring", "source", "a template", "a photo", "the same output", "a new photo", "one less"],
)  # fmt: skip
def test_a_change_reruns_what_it_reaches(project, file, text, step, reason, runs):
    write(project.root / file, text or "")
    if text is None:
        (project.root / file).unlink()
    assert reasons(project, step) == ([reason] if reason else [])
    assert new_runs(project) == runs
    photos = {path.stem for path in (project.build / "set" / "upper").glob("*.txt")}
    assert photos == set(toy.read(project.root / "data" / "set").photos)


def test_a_parameter_reruns_its_stage_and_the_old_result_is_still_there_and_force_runs_just_what_is_named(project):
    assert new_runs(project, "table.scale=3") == ["table", "total"] and total(project) == "total: 27"
    assert new_runs(project) == [] and total(project) == "total: 18"
    assert new_runs(project, targets=["upper"], force=True) == ["upper/a", "upper/b"]


def test_the_verdict_of_a_result_is_shown_and_only_when_asked_for_decides_the_exit_code(project, capsys):
    assert make(project) == 0
    for text, code in (("good: indeed\n", 0), ("do not trust: 9 dB\nbecause of that\n", verbs.UNTRUSTED)):
        write(project.build / "set" / verbs.VERDICT, text)
        assert verbs.make(project, verbs.Request("set")) == 0
        assert verbs.make(project, verbs.Request("set"), strict=True) == code
        output = capsys.readouterr().out
        assert all(output.count(line) == 2 for line in text.splitlines())
    assert verbs.make(project, verbs.Request("set", ["upper"]), strict=True) == 0  # not of the whole


def test_plan_and_why_show_the_same_plan(project, capsys):
    write(project.root / "data" / "set" / "a.txt", "Alphabet")
    for show, output in (
        (verbs.show_plan, "upper      to run  a                        file a.txt: changed"),
        (partial(verbs.show_plan, every_reason=True), "upper      to run  a\n    file a.txt: changed"),
    ):
        assert show(project, verbs.Request("set")) == 0 and output in capsys.readouterr().out


# ── what is refused ──────────────────────────────────────────────────────────────────────────────────────────────────


def test_a_setting_nobody_takes_is_refused_at_once_and_said_of_the_setting(project, capsys):
    for setting, words in (
        ("tabel.scale=3", "did you mean 'table'"),
        ("table.scale", "stage.parameter=value"),
        ("table.preset=fast", "no preset 'fast'"),
    ):
        caught = refusal(".", make, project, setting)
        assert words in str(caught) and "pipeline.yaml" not in str(caught)
    for setting, words in (("table.scael=3", "did you mean 'scale'"), ("count.x=1", "unknown key 'x'")):
        for verb in (verbs.make, verbs.show_plan):
            assert verb(project, verbs.Request("set", settings=[setting])) == 1
            output = capsys.readouterr().err
            assert output.startswith(f"error: SET {setting}: ") and words in output and "nothing was run" in output


def test_a_parameter_of_a_stage_that_takes_those_of_others_is_set_there():
    pipeline = Pipeline(1, {"solve": Stage(), "again": Stage(params_of=["solve"])})
    refusal("set it of one of these: solve.cells=", with_settings, pipeline, ["again.cells=8"])


@pytest.mark.parametrize("param, value", [("times", "0"), ("times", "two"), ("sleep", "[1]")])
def test_a_value_out_of_bounds_is_refused_before_anything_runs_and_says_who_gave_it(project, capsys, param, value):
    before = done(project)
    for verb in (verbs.make, verbs.show_plan):
        assert verb(project, verbs.Request("set", settings=[f"upper.{param}={value}"])) == 1
        output = capsys.readouterr()
        assert f": SET upper.{param}={value}: " in output.err and "pipeline.yaml" not in output.err and not output.out
    edit(project, "pipeline.yaml", "upper: {", f"upper: {{params: {{{param}: {value}}}, ")
    assert verbs.show_plan(project, verbs.Request("set")) == 1 and done(project) == before
    output = capsys.readouterr().err
    assert "pipeline.yaml: " in output and f"stages.upper.params.{param}: " in output and "SET" not in output


def test_a_dataset_that_is_not_there_and_two_folders_of_one_name_are_refused(project, tmp_path):
    write(project.root / "data" / "set" / "dataset.yaml", "")
    caught = refusal("no dataset 'sett'", verbs.make, project, verbs.Request("sett"))
    assert "did you mean 'set'" in caught.cure
    shutil.copytree(project.root / "data" / "set", tmp_path / "else" / "set")
    refusal("two datasets are called 'set'", verbs.make, project, verbs.Request(str(tmp_path / "else" / "set")))
    assert verbs.make(project, verbs.Request(str(project.root / "data" / "set"))) == 0  # the same one by its path
    shutil.move(project.root / "data" / "set", tmp_path / "set")
    assert verbs.make(project, verbs.Request(str(tmp_path / "set"))) == 0
    assert verbs.make(project, verbs.Request("set")) == 0  # its results name its folder, as the report's commands do


# ── what fails ───────────────────────────────────────────────────────────────────────────────────────────────────────


def test_a_failing_step_holds_up_only_what_needs_it(project, capsys):
    write(project.root / "data" / "set" / "a.txt", "bad")
    write(project.root / "data" / "set" / "c.txt", "Gamma")
    assert make(project) == 1
    output = capsys.readouterr().err
    assert "upper/a: a.txt: line 1: a bad word" in output and "use a better one" in output and "Traceback" not in output
    assert done(project)[-2:] == ["upper/c", "count/c"] and state(project)["count/c"] == "current"
    assert not (project.build / "set" / "upper" / "a.txt").exists(), "a result that is not current is shown"
    log = project.build / "set" / "log.jsonl"
    whole = log.read_bytes()
    log.write_bytes(whole + b'{"event": "fai')  # of a run that was killed
    assert verbs.show_status(project, verbs.Request("set")) == 0
    assert "error: upper/a: a.txt: line 1: a bad word" in capsys.readouterr().out
    log.write_bytes(whole)
    write(project.root / "data" / "set" / "a.txt", "good")
    assert verbs.show_status(project, verbs.Request("set")) == 0 and "error" not in capsys.readouterr().out
    assert new_runs(project) == ["count/a", "total", "upper/a"]


@pytest.mark.parametrize(
    "file, old, new, words, traced",
    [
        ("stages/table.py", WRITES, "json.dumps(1 / 0)", "table: ZeroDivisionError", True),
        ("stages/table.py", "    (out", "    import os; os.abort()\n    (out", "process died", False),
        ("pipeline.yaml", "[total.txt]", "[total.txt, more.txt]", "more.txt", True),
    ],
    ids=["a defect", "a worker that dies", "a stage that does not keep its word"],
)
def test_what_goes_wrong_in_a_stage_fails_its_step_and_the_next_run_resumes(
    project, capsys, file, old, new, words, traced
):
    text = edit(project, file, old, new)
    assert make(project) == 1
    output = capsys.readouterr().err
    assert words in output and ("a defect of the program" in output) == ("Traceback" in output) == traced
    event = json.loads((project.build / "set" / "log.jsonl").read_text().splitlines()[-1])
    assert event["event"] == "failed" and words.removeprefix("table: ") in event["text"]
    assert ("Traceback" in (event["traceback"] or "")) == traced
    write(project.root / file, text)
    assert new_runs(project) == []


# ── what is told ─────────────────────────────────────────────────────────────────────────────────────────────────────


def test_a_run_ends_with_at_most_five_lines_of_warnings_each_of_one_fault():
    warnings = [
        (Step(f"stage{k}", photo), f"{photo} is odd by {n} %") for k in range(7) for n, photo in enumerate("xy")
    ]
    lines = display.warning_lines(warnings)
    assert lines[0] == "warning: stage0/x: x is odd by 0 % (and 1 more: y)" and len(lines) == display.MOST_WARNINGS
    assert lines[-1].startswith("3 more warnings: `make status`")


def test_warnings_are_printed_at_the_end_of_any_run_and_before_the_error_of_their_step(capsys):
    shown, steps = display.Display(), [Step("upper", "a"), Step("upper", "b")]
    shown.warnings += [(step, f"{step.item} is odd") for step in steps]
    shown.fail(steps[1], "bad", None)
    shown.close()
    expected = ["warning: upper/b: b is odd", "error: upper/b: bad", "warning: upper/a: a is odd"]
    assert capsys.readouterr().err.splitlines() == expected


# ── processes ────────────────────────────────────────────────────────────────────────────────────────────────────────


def test_the_second_of_two_runs_waits_and_takes_the_firsts_result(project, capsys):
    go = project.root / "go"
    toy.wait_for(project, go)
    first = start(project)
    assert wait_until(lambda: [*(project.build / "store" / "tmp").glob("run-*/upper-*/a.txt")]), "no step writes"
    verbs.show_status(project, verbs.Request("set"))
    assert re.search(r"^upper +[12] running", capsys.readouterr().out)
    refusal("a run is using this store", clean, project, "set")
    second = start(project)
    waits = any("another run is making it" in line for line in second.stdout)
    go.touch()
    output = second.communicate(timeout=60)[0]
    assert waits and first.wait(timeout=60) == 0 and second.returncode == 0, output
    first.stdout.close()
    assert sorted(done(project)).count("upper/a") == 2  # once in the fixture, once for both


def test_threads_are_those_of_the_stage_and_hashes_are_fixed_whatever_the_machine(project):
    names = ("OMP_NUM_THREADS", "PYTHONHASHSEED")
    edit(project, "stages/table.py", WRITES, f"str([__import__('os').environ[name] for name in {names}])")
    edit(project, "pipeline.yaml", "table: {}", "table: {threads: 3}")
    assert make(project, targets=["table"]) == 0 and table(project) == "['3', '0']"


def test_what_a_killed_step_left_to_go_on_from_outlives_it_and_goes_with_success(project):
    note = """note = inputs.unfinished / "n"
    note.parent.mkdir(parents=True, exist_ok=True)
    if not note.exists():
        note.write_text("half")
        raise RuntimeError("killed")
    (out /"""
    edit(project, "stages/table.py", "(out /", note)
    assert make(project) != 0 and len(list((project.build / "store" / "unfinished").iterdir())) == 1
    assert make(project) == 0 and not list((project.build / "store" / "unfinished").iterdir())


# ── a folder that a parameter names ──────────────────────────────────────────────────────────────────────────────────


def test_a_given_folder_is_read_and_counts_by_content_not_by_place(project, tmp_path):
    """Of the toy whose table reads start/seed.txt where it is given one; everything is current without."""
    seed = '(inputs["start"] / "seed.txt").read_text() if "start" in inputs.folders else params.scale'
    edit(project, "pipeline.yaml", "table: {}", "table: {given: {start: [seed.txt]}}")
    edit(project, "stages/table.py", WRITES, f"str({seed})")
    write(tmp_path / "one" / "seed.txt", "5")
    assert make(project) == 0
    one, other = (f"table.start={tmp_path / folder}" for folder in ("one", "other"))
    assert new_runs(project, one) == ["table", "total"] and total(project) == "total: 45"
    shutil.copytree(tmp_path / "one", tmp_path / "other")
    write(tmp_path / "other" / "more.txt", "not read")
    assert new_runs(project, other) == []
    write(tmp_path / "other" / "seed.txt", "6")
    assert reasons(project, "table", settings=(other,)) == ["given file start/seed.txt: changed"]
    assert new_runs(project, other) == ["table", "total"]
    assert new_runs(project) == [] and total(project) == "total: 18", "it is off unless named"
    assert str(tmp_path) not in "".join(path.read_text() for path in (project.build / "store" / "keys").iterdir())
    edit(project, "stages/table.py", "    (out", "    (inputs['start'] / 'seed.txt').write_text('9')\n    (out")
    assert make(project, one) == 1, "what changes while it is read is no result"


def test_the_folder_of_a_run_goes_even_if_a_step_writes_to_it_while_it_is_deleted(tmp_path, monkeypatch):
    folder, alive = begin_run(Store(tmp_path / "store"))
    alive.release()
    delete, late = shutil.rmtree, iter("12")

    def delete_while_one_writes(path, ignore_errors):
        delete(path)
        for name in itertools.islice(late, 1):
            (path / name).mkdir(parents=True)

    monkeypatch.setattr(shutil, "rmtree", delete_while_one_writes)
    end_run(folder)
    assert not folder.exists() and not list(late)


def test_two_that_ask_whether_a_run_lives_do_not_take_each_other_for_it(tmp_path):
    path = tmp_path / "lock"
    held = lock(path)
    assert is_locked(path)
    held.release()
    with open(path, "rb") as asking:
        fcntl.flock(asking, fcntl.LOCK_SH)
        assert not is_locked(path)


# ── Results of others: a store that checkouts share, and results that ship with the source ──────────


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
        caught = refusal("no such folder", verb, project, verbs.Request("set"))
        assert "FACTORLIB_STORE" in str(caught)
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
