"""Real runs of a toy pipeline: what runs, what is kept, what is shown, what survives."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time

import pytest

from factorlib.errors import InputError
from factorlib.runner import verbs
from factorlib.runner.executors import Pools
from factorlib.runner.gc import collect
from factorlib.runner.project import LIBRARY
from tests.faults.battered import own_modules
from tests.runner import toy
from tests.runner.toy import files_of, make_project, reasons, state, write


def make(project, dataset="set", settings=(), targets=None, force=False):
    return verbs.make(project, verbs.Wish(dataset, targets, list(settings), force))


def ran(project, dataset="set"):
    """The steps of the run log, in order."""
    events = map(json.loads, (project.build / dataset / "log.jsonl").read_text().splitlines())
    return ["/".join(filter(None, (e["stage"], e["photo"]))) for e in events if e["event"] == "done"]


def new_runs(project, **options):
    before = len(ran(project))
    assert make(project, **options) == 0
    return sorted(ran(project)[before:])


def total(project):
    return (project.build / "set" / "total" / "total.txt").read_text()


@pytest.fixture(scope="session")
def made_once(tmp_path_factory):
    made = make_project(tmp_path_factory.mktemp("toy") / "root")
    assert make(made) == 0
    return made


@pytest.fixture
def project(made_once, tmp_path):
    """The toy, everything current, in a folder of its own."""
    return toy.copy(made_once, tmp_path / "a root with spaces")


def test_all_results_stand_under_the_datasets_name_read_only_and_their_costs_in_a_log(project, capsys):
    home = project.build / "set"
    assert total(project) == "total: 18"
    assert (home / "total" / "log.txt").read_text() == "5"  # upper and count of two photos, table
    assert json.loads((home / "upper" / "sizes.json").read_text()) == {"a": {"size": 5}, "b": {"size": 4}}
    assert sorted(p.name for p in (home / "upper").iterdir()) == ["a.json", "a.txt", "b.json", "b.txt", "sizes.json"]
    assert not list((project.build / "store" / "tmp").iterdir()), "something is left behind"
    files = [p for folder in ("trees", "views") for p in (project.build / "store" / folder).rglob("*") if p.is_file()]
    assert files and not any(p.stat().st_mode & 0o222 for p in files)
    event = json.loads((home / "log.jsonl").read_text().splitlines()[0])
    assert (
        event["seconds"] > 0 and event["memory_mb"] > 1 and event["threads"] == 1 and event["key"] and event["started"]
    )
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
    ],
    ids=["a remark", "a docstring", "source", "a template", "a photo", "the same output", "a new photo"],
)  # fmt: skip
def test_a_change_reruns_what_it_reaches(project, file, text, step, reason, runs):
    write(project.root / file, text)
    assert reasons(project, step) == ([reason] if reason else [])
    assert new_runs(project) == runs


def test_a_photo_that_is_taken_away_vanishes(project):
    (project.root / "data" / "set" / "a.txt").unlink()
    assert new_runs(project) == ["total"]
    assert [p.name for p in (project.build / "set" / "upper").glob("*.txt")] == ["b.txt"]


def test_a_parameter_reruns_its_stage_and_the_old_result_is_still_there_and_force_runs_just_what_is_named(project):
    assert new_runs(project, settings=["table.scale=3"]) == ["table", "total"] and total(project) == "total: 27"
    assert new_runs(project) == [] and total(project) == "total: 18"
    assert new_runs(project, targets=["upper"], force=True) == ["upper/a", "upper/b"]


def test_another_directory_gives_the_same_bytes_and_datasets_share_what_is_the_same(project, tmp_path):
    other = make_project(tmp_path / "other")
    assert make(other) == 0
    trees = [{p.name for p in (each.build / "store" / "trees").iterdir()} for each in (project, other)]
    assert trees[0] == trees[1]
    shutil.copytree(project.root / "data" / "set", project.root / "data" / "again")
    assert set(state(project, "again").values()) == {"current"} and make(project, "again") == 0
    assert (project.build / "again" / "total" / "total.txt").exists()


# ── what is refused ──────────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize(
    "setting, words",
    [
        ("tabel.scale=3", "did you mean 'table'"),
        ("table.scael=3", "did you mean 'scale'"),
        ("table.scale", "stage.parameter=value"),
        ("count.x=1", "no parameter"),
    ],
)
def test_a_setting_nobody_takes_is_refused_at_once_and_said_of_the_setting(project, setting, words):
    for verb in (verbs.make, verbs.show_plan):
        with pytest.raises(InputError) as caught:
            verb(project, verbs.Wish("set", settings=[setting]))
        assert words in str(caught.value) and "pipeline.yaml" not in str(caught.value)


@pytest.mark.parametrize("setting", ["upper.times=0", "upper.times=two", "table.scale=1.5"])
def test_a_value_out_of_bounds_is_refused_before_anything_runs_and_says_who_gave_it(project, capsys, setting):
    before = ran(project)
    for verb in (verbs.make, verbs.show_plan, verbs.show_why):
        with own_modules("stages", "toylib"):
            assert verb(project, verbs.Wish("set", settings=[setting])) == 1
        said = capsys.readouterr()
        assert f": SET {setting}: " in said.err
        assert "pipeline.yaml" not in said.err and not said.out
    assert ran(project) == before
    stage, param, value = re.fullmatch(r"(\w+)\.(\w+)=(.*)", setting).groups()
    opened = {"upper": "upper: {", "table": "table: {"}[stage]
    text = f"{opened}params: {{{param}: {value}}}{', ' if stage == 'upper' else ''}"
    write(project.root / "pipeline.yaml", toy.PIPELINE.replace(opened, text))
    with own_modules("stages", "toylib"):
        assert verbs.show_plan(project, verbs.Wish("set")) == 1
    said = capsys.readouterr().err
    assert "pipeline.yaml: " in said and f"stages.{stage}.params.{param}: " in said and "SET" not in said


@pytest.mark.parametrize("name", ["studies", "bench", "store"])
def test_reserved_names(project, name):
    shutil.copytree(project.root / "data" / "set", project.root / "data" / name)
    with pytest.raises(InputError, match=name):
        make(project, name)


def test_a_dataset_that_is_not_there_and_two_folders_of_one_name_are_refused(project, tmp_path):
    write(project.root / "data" / "set" / "dataset.yaml", "")
    with pytest.raises(InputError, match="no dataset 'sett'") as caught:
        make(project, "sett")
    assert "did you mean 'set'" in caught.value.cure
    shutil.copytree(project.root / "data" / "set", tmp_path / "else" / "set")
    with pytest.raises(InputError, match="two datasets are called 'set'"):
        make(project, str(tmp_path / "else" / "set"))
    assert make(project, str(project.root / "data" / "set")) == 0  # the same one by its path


# ── what fails ───────────────────────────────────────────────────────────────────────────────────────────────────────


def test_a_failing_step_holds_up_only_what_needs_it(project, capsys):
    write(project.root / "data" / "set" / "a.txt", "bad")
    write(project.root / "data" / "set" / "c.txt", "Gamma")
    assert make(project) == 1
    said = capsys.readouterr().err
    assert "upper/a: a.txt: line 1: a bad word" in said and "use a better one" in said and "Traceback" not in said
    assert ran(project)[-2:] == ["upper/c", "count/c"] and state(project)["count/c"] == "current"
    assert not (project.build / "set" / "upper" / "a.txt").exists(), "a result that is not current is shown"
    write(project.root / "data" / "set" / "a.txt", "good")
    assert new_runs(project) == ["count/a", "total", "upper/a"]


@pytest.mark.parametrize(
    "file, old, new, words, traced",
    [
        ("stages/table.py", "json.dumps(params.scale)", "json.dumps(1 / 0)", "table: ZeroDivisionError", ["table.txt"]),
        ("stages/table.py", "    (out", "    import os; os.abort()\n    (out", "process died", []),
        ("pipeline.yaml", "[total.txt]", "[total.txt, more.txt]", "more.txt", ["total.txt"]),
    ],
    ids=["a defect", "a worker that dies", "a stage that does not keep its word"],
)
def test_what_goes_wrong_in_a_stage_fails_its_step_and_the_next_run_resumes(
    project, capsys, file, old, new, words, traced
):
    text = (project.root / file).read_text()
    write(project.root / file, text.replace(old, new))
    assert make(project) == 1
    said = capsys.readouterr().err
    assert words in said and "Traceback" not in said
    assert [path.name for path in (project.build / "set").glob("errors/*")] == traced
    write(project.root / file, text)
    assert new_runs(project) == []


def test_a_name_as_long_as_the_file_system_allows_is_as_good_as_a_short_one(tmp_path, capsys):
    long = ["k" * 239 + end for end in "ab"]
    project = make_project(tmp_path, **{long[0]: "Alpha", long[1]: "1/0"})
    fails = toy.COUNT.replace("    (out", "    assert not inputs.photo.endswith('b')\n    (out")
    write(project.root / "stages" / "count.py", fails.replace("import json", "import json\nassert True", 1))
    assert make(project) == 1
    assert (project.build / "set" / "upper" / f"{long[0]}.txt").read_text() == "ALPHA"
    assert state(project)[f"count/{long[0]}"] == "current" and "AssertionError" in capsys.readouterr().err
    assert len(list((project.build / "set" / "errors").iterdir())) == 1
    write(project.root / "stages" / "count.py", toy.COUNT)
    assert make(project) == 0 and not (project.build / "set" / "errors").exists()
    assert not [p for p in (project.build / "store").rglob("*") if "kkk" in p.name and not p.name.startswith("k")]


def test_warnings_are_said_once_and_kept(project, capsys):
    write(project.root / "data" / "set" / "a.txt", "odd")
    assert make(project) == 0
    assert capsys.readouterr().err.count("a is odd") == 1
    assert verbs.show_status(project, verbs.Wish("set")) == 0
    assert "a is odd" in capsys.readouterr().out


# ── cleaning ─────────────────────────────────────────────────────────────────────────────────────────────────────────


def test_gc_shows_by_stage_and_age_what_is_not_current_asks_and_deletes_that_alone(project, capsys):
    make(project, settings=["table.scale=3"])
    make(project)
    before = {stage: files_of(project.build / "set" / stage) for stage in ("upper", "count", "table", "total")}
    for key in (project.build / "store" / "keys").iterdir():
        os.utime(key, (time.time() - 3 * 86400 - 60,) * 2)
    capsys.readouterr()
    assert verbs.collect(project, lambda: False) == 0
    said = capsys.readouterr().out
    assert re.search(r"^table +1 result .* MB   3 days old$", said, re.M) and re.search(
        r"^total +1 result ", said, re.M
    )
    assert "nothing was deleted" in said and state(project, settings=("table.scale=3",))["table"] == "current"
    assert verbs.collect(project, lambda: True) == 0 and "deleted 2 results" in capsys.readouterr().out
    assert {stage: files_of(project.build / "set" / stage) for stage in before} == before
    assert (
        set(state(project).values()) == {"current"} and state(project, settings=("table.scale=3",))["table"] == "to run"
    )
    assert verbs.collect(project, pytest.fail) == 0  # nothing is asked where there is nothing to free


def test_clean_takes_a_dataset_and_then_gc_its_results(project):
    assert verbs.clean(project, "set") == 0
    assert not (project.build / "set").exists() and set(state(project).values()) == {"current"}
    collect(project)
    assert "current" not in state(project).values()


def test_a_folder_in_place_of_a_keys_record_is_a_result_that_is_gone(project):
    keys = project.build / "store" / "keys"
    path = next(path for path in keys.iterdir() if json.loads(path.read_text())["record"]["stage"] == "total")
    path.unlink()
    path.mkdir()
    assert new_runs(project) == ["total"] and path.is_file()


# ── processes ────────────────────────────────────────────────────────────────────────────────────────────────────────


def heed_interrupts():
    """A shell hands SIGINT down as ignored to what it runs in the background, this test perhaps."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def background(project, *settings):
    command = [sys.executable, toy.__file__, str(project.root), "set", *settings]
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    environment = {**os.environ, "PYTHONPATH": str(LIBRARY)}
    return subprocess.Popen(command, env=environment, preexec_fn=heed_interrupts, **streams)


def wait_for_sleepers(project, seconds=20):
    """Until a step of `upper` has written its files, and waits."""
    end = time.monotonic() + seconds
    while not list((project.build / "store" / "tmp").glob("run-*/upper-*/a.txt")):
        assert time.monotonic() < end, "it never came to that"
        time.sleep(0.02)


def test_the_second_of_two_runs_waits_and_takes_the_firsts_result(project, capsys):
    go = project.root / "go"
    toy.wait_for(project, go)
    first = background(project)
    wait_for_sleepers(project)
    verbs.show_status(project, verbs.Wish("set"))
    assert re.search(r"^upper +[12] running", capsys.readouterr().out)
    with pytest.raises(InputError, match="a run is going on"):
        collect(project)
    second = background(project)
    waits = any("another run is making it" in line for line in second.stdout)
    go.touch()
    said = second.communicate(timeout=60)[0]
    assert waits
    assert first.wait(timeout=60) == 0 and second.returncode == 0, said
    first.stdout.close()
    assert sorted(ran(project)).count("upper/a") == 2  # once in the fixture, once for both


def test_a_run_that_is_interrupted_stops_its_workers(project):
    process = background(project, "upper.sleep=30")
    wait_for_sleepers(project)
    process.send_signal(signal.SIGINT)
    said = process.communicate(timeout=20)[0]
    assert process.returncode == 130 and "stopped" in said and "Traceback" not in said
    assert not list((project.build / "store" / "tmp").iterdir())


@pytest.mark.parametrize("kill", [False, True])
def test_pools_that_are_closed_have_no_threads_left(kill):
    before = set(threading.enumerate())
    pools = Pools()
    futures = [pools.submit(1, 1, time.sleep, 60 if kill else 0) for _ in range(2)]
    if not kill:
        for future in futures:
            future.result()
            pools.done(future)
    pools.close(kill)
    assert set(threading.enumerate()) == before  # one that closes while Python ends is a traceback after "stopped"


def test_plan_why_and_graph_show_the_same_plan(project, capsys):
    write(project.root / "data" / "set" / "a.txt", "Alphabet")
    verbs.show_plan(project, verbs.Wish("set"))
    assert "upper      to run  a                        file a.txt: changed" in capsys.readouterr().out
    verbs.show_why(project, verbs.Wish("set"))
    assert "upper a: to run\n    file a.txt: changed" in capsys.readouterr().out
    verbs.show_graph(project, False)
    assert "total      whole set  <- count, table" in capsys.readouterr().out
    verbs.show_graph(project, True)
    assert "upper --> count" in capsys.readouterr().out


@pytest.mark.parametrize("name, value", [("OMP_NUM_THREADS", "3"), ("PYTHONHASHSEED", "0")])
def test_threads_are_those_of_the_stage_and_hashes_are_fixed_whatever_the_machine(tmp_path, name, value):
    project = make_project(tmp_path)
    text = toy.TABLE.replace("json.dumps(params.scale)", f"__import__('os').environ['{name}']")
    write(tmp_path / "stages" / "table.py", text)
    write(tmp_path / "pipeline.yaml", toy.PIPELINE.replace("table: {}", "table: {threads: 3}"))
    assert make(project, targets=["table"]) == 0
    assert (project.build / "set" / "table" / "table.json").read_text() == value


@pytest.mark.parametrize("cores, expected", [("all", 2), ("1", 1), ("64", 2)])
def test_a_step_has_the_cores_it_asks_for_as_far_as_the_machine_goes_and_they_are_in_no_key(
    tmp_path, monkeypatch, cores, expected
):
    monkeypatch.setattr("factorlib.runner.executors.machine_cores", lambda: 2)
    project = make_project(tmp_path)
    many = "len(set(inputs.map(lambda _: (__import__('time').sleep(0.1), __import__('threading').get_ident())[1], range(6))))"
    write(tmp_path / "stages" / "table.py", toy.TABLE.replace("json.dumps(params.scale)", f"str({many})"))
    write(tmp_path / "pipeline.yaml", toy.PIPELINE.replace("table: {}", f"table: {{cores: {cores}}}"))
    assert make(project, targets=["table"]) == 0
    assert (project.build / "set" / "table" / "table.json").read_text() == str(expected)
    write(tmp_path / "pipeline.yaml", toy.PIPELINE)
    assert new_runs(project, targets=["table"]) == []


def test_what_a_killed_step_left_to_go_on_from_outlives_it_and_goes_with_success(project):
    note = """note = inputs.unfinished / "n"
    note.parent.mkdir(parents=True, exist_ok=True)
    if not note.exists():
        note.write_text("half")
        raise RuntimeError("killed")
    (out /"""
    write(project.root / "stages" / "table.py", toy.TABLE.replace("(out /", note, 1))
    assert make(project) != 0 and len(list((project.build / "store" / "unfinished").iterdir())) == 1
    assert make(project) == 0 and not list((project.build / "store" / "unfinished").iterdir())


# ── a folder that a parameter names ──────────────────────────────────────────────────────────────────────────────────


@pytest.fixture
def giving(project, tmp_path):
    """The toy whose table reads start/seed.txt where it is given one; everything current without."""
    pipeline = toy.PIPELINE.replace("table: {}", "table: {given: {start: [seed.txt]}}")
    seed = '(inputs["start"] / "seed.txt").read_text() if "start" in inputs.folders else params.scale'
    write(project.root / "pipeline.yaml", pipeline)
    write(project.root / "stages" / "table.py", toy.TABLE.replace("json.dumps(params.scale)", f"str({seed})"))
    write(tmp_path / "one" / "seed.txt", "5")
    assert make(project) == 0
    return project


def test_a_given_folder_is_read_and_counts_by_content_not_by_place(giving, tmp_path):
    named = lambda folder: [f"table.start={tmp_path / folder}"]  # noqa: E731
    assert new_runs(giving, settings=named("one")) == ["table", "total"]
    assert total(giving) == "total: 45"
    shutil.copytree(tmp_path / "one", tmp_path / "other")
    write(tmp_path / "other" / "more.txt", "not read")
    assert new_runs(giving, settings=named("other")) == []
    write(tmp_path / "other" / "seed.txt", "6")
    assert reasons(giving, "table", settings=named("other")) == ["given file start/seed.txt: changed"]
    assert new_runs(giving, settings=named("other")) == ["table", "total"]
    assert new_runs(giving) == [] and total(giving) == "total: 18", "it is off unless named"
    assert str(tmp_path) not in "".join(path.read_text() for path in (giving.build / "store" / "keys").iterdir())


@pytest.mark.parametrize(
    "folder, words", [("nowhere", "no such folder"), (".", "no readable 'seed.txt'"), ("3", "no such folder")]
)
def test_a_given_folder_that_is_not_there_is_refused_before_anything_runs(giving, tmp_path, folder, words):
    named = folder if folder == "3" else tmp_path / folder
    with pytest.raises(InputError) as caught:
        make(giving, settings=[f"table.start={named}"])
    said = str(caught.value)
    assert words in said and "table.start" in said and "name a folder with seed.txt" in said


def test_a_given_file_that_changes_while_it_is_read_is_no_result(giving, tmp_path):
    text = (giving.root / "stages" / "table.py").read_text().rstrip("\n")
    write(giving.root / "stages" / "table.py", text + '\n    (inputs["start"] / "seed.txt").write_text("9")\n')
    assert make(giving, settings=[f"table.start={tmp_path / 'one'}"]) == 1
