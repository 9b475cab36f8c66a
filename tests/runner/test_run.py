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
from pathlib import Path

import pytest

from factorlib.errors import InputError
from factorlib.runner import verbs
from factorlib.runner.executors import Pools
from factorlib.runner.gc import collect
from factorlib.runner.project import LIBRARY
from factorlib.runner.store import Store
from tests.faults.test_many_photos import own_modules
from tests.runner import toy
from tests.runner.toy import files_of, make_project, reasons, state, write


def make(project, dataset="set", settings=(), targets=None, force=False):
    return verbs.make(project, verbs.Wish(dataset, targets, list(settings), force))


def ran(project, dataset="set"):
    """The steps of the run log, in order."""
    lines = (project.build / dataset / "log.jsonl").read_text().splitlines()
    return [
        f"{e['stage']}/{e['photo']}" if e["photo"] else e["stage"]
        for e in map(json.loads, lines)
        if e["event"] == "done"
    ]


def new_runs(project, **options):
    before = len(ran(project))
    assert make(project, **options) == 0
    return sorted(ran(project)[before:])


@pytest.fixture(scope="session")
def made_once(tmp_path_factory):
    made = make_project(tmp_path_factory.mktemp("toy") / "root")
    assert make(made) == 0
    return made


@pytest.fixture
def project(made_once, tmp_path):
    """The toy, everything current, in a folder of its own."""
    return toy.copy(made_once, tmp_path / "a root with spaces")


def test_all_results_stand_under_the_datasets_name(project):
    home = project.build / "set"
    assert (home / "total" / "total.txt").read_text() == "total: 18"
    assert (home / "total" / "log.txt").read_text() == "5"  # upper and count of two photos, table
    assert json.loads((home / "upper" / "sizes.json").read_text()) == {"a": {"size": 5}, "b": {"size": 4}}
    assert sorted(p.name for p in (home / "upper").iterdir()) == ["a.json", "a.txt", "b.json", "b.txt", "sizes.json"]
    assert not list((project.build / "store" / "tmp").iterdir()), "something is left behind"


def test_store_files_are_read_only(project):
    files = [p for folder in ("trees", "views") for p in (project.build / "store" / folder).rglob("*") if p.is_file()]
    assert files and not any(p.stat().st_mode & 0o222 for p in files)


def test_the_log_has_what_a_step_cost_and_artifacts_have_not(project):
    event = json.loads((project.build / "set" / "log.jsonl").read_text().splitlines()[0])
    assert (
        event["seconds"] > 0 and event["memory_mb"] > 1 and event["threads"] == 1 and event["key"] and event["started"]
    )


def test_a_second_run_does_nothing(project, capsys):
    assert new_runs(project) == []
    assert "nothing to do" in capsys.readouterr().out


def test_a_comment_reruns_nothing(project):
    write(project.root / "stages" / "upper.py", "# a remark\n" + toy.UPPER)
    write(project.root / "toylib" / "letters.py", toy.LETTERS.replace("How many", "How very many"))
    assert set(state(project).values()) == {"current"}


def test_the_source_of_an_imported_module_counts(project):
    write(project.root / "toylib" / "letters.py", toy.LETTERS.replace("isalpha", "isupper"))
    assert reasons(project, "count/a") == ["source of toylib.letters: changed"]
    assert state(project)["upper/a"] == "current" and state(project)["total"] == "maybe"
    assert new_runs(project) == ["count/a", "count/b"]  # they come out the same, so total stays


def test_a_template_counts(project):
    write(project.root / "stages" / "templates" / "total.html", "in all: ")
    assert reasons(project, "total") == ["package data stages:templates/total.html: changed"]


def test_a_changed_photo_reruns_its_steps_and_the_set(project):
    write(project.root / "data" / "set" / "a.txt", "Alphabet")
    assert reasons(project, "upper/a") == ["file a.txt: changed"]
    assert new_runs(project) == ["count/a", "total", "upper/a"]
    write(project.root / "data" / "set" / "a.txt", "alphabeT")
    assert new_runs(project) == ["upper/a"]


def test_a_new_photo_costs_one_photo_and_one_taken_away_vanishes(project):
    write(project.root / "data" / "set" / "c.txt", "Gamma")
    assert new_runs(project) == ["count/c", "total", "upper/c"]
    (project.root / "data" / "set" / "a.txt").unlink()
    assert new_runs(project) == ["total"]
    assert (
        not (project.build / "set" / "upper" / "a.txt").exists()
        and (project.build / "set" / "upper" / "c.txt").exists()
    )


def test_a_parameter_reruns_its_stage_and_the_old_one_is_still_there(project):
    assert new_runs(project, settings=["table.scale=3"]) == ["table", "total"]
    assert (project.build / "set" / "total" / "total.txt").read_text() == "total: 27"
    assert new_runs(project) == []
    assert (project.build / "set" / "total" / "total.txt").read_text() == "total: 18"


def test_force_runs_just_the_named_stage_again(project):
    assert new_runs(project, targets=["upper"], force=True) == ["upper/a", "upper/b"]


@pytest.mark.parametrize(
    "setting, words",
    [
        ("tabel.scale=3", "did you mean 'table'"),
        ("table.scael=3", "did you mean 'scale'"),
        ("table.scale", "stage.parameter=value"),
        ("count.x=1", "no parameter"),
    ],
)
def test_a_setting_nobody_takes_is_refused_at_once(project, setting, words):
    with pytest.raises(InputError) as caught:
        make(project, settings=[setting])
    assert words in str(caught.value)


@pytest.mark.parametrize("setting", ["upper.times=0", "upper.times=two", "table.scale=1.5"])
def test_a_value_out_of_bounds_is_refused_before_anything_runs(project, capsys, setting):
    before = ran(project)
    assert make(project, settings=[setting]) == 1
    said = capsys.readouterr().err
    assert f"SET {setting}: " in said and "pipeline.yaml" not in said
    assert ran(project) == before


@pytest.mark.parametrize("setting", ["upper.times=0", "upper.times=two", "table.scale=1.5"])
@pytest.mark.parametrize("verb", [verbs.show_plan, verbs.show_why])
def test_a_plan_checks_values_and_says_who_gave_them(project, capsys, verb, setting):
    with own_modules("stages", "toylib"):
        assert verb(project, verbs.Wish("set", settings=[setting])) == 1
    said = capsys.readouterr()
    assert f"error: SET {setting}: " in said.err and "pipeline.yaml" not in said.err and not said.out
    name, value = setting.split("=")
    stage, param = name.split(".")
    of_file = {"upper": toy.PIPELINE.replace("[dataset.photo], ", f"[dataset.photo], params: {{{param}: {value}}}, "),
               "table": toy.PIPELINE.replace("table: {}", f"table: {{params: {{{param}: {value}}}}}")}  # fmt: skip
    write(project.root / "pipeline.yaml", of_file[stage])
    with own_modules("stages", "toylib"):
        assert verb(project, verbs.Wish("set")) == 1
    said = capsys.readouterr().err
    assert "pipeline.yaml: " in said and f"stages.{stage}.params.{param}: " in said and "SET" not in said


def test_an_unknown_parameter_of_a_setting_is_said_of_the_setting(project):
    with pytest.raises(InputError) as caught:
        verbs.show_plan(project, verbs.Wish("set", settings=["table.scael=3"]))
    assert str(caught.value).startswith("SET table.scael=3: ")


def test_a_name_as_long_as_the_file_system_allows_is_as_good_as_a_short_one(tmp_path, capsys):
    long = ["k" * 239 + end for end in "ab"]
    project = make_project(tmp_path, **{long[0]: "Alpha", long[1]: "1/0"})
    write(project.root / "stages" / "count.py", toy.COUNT.replace("import json", "import json\nassert True", 1).replace(
        "    (out", "    assert not inputs.photo.endswith('b')\n    (out"))  # fmt: skip
    assert make(project) == 1
    assert (project.build / "set" / "upper" / f"{long[0]}.txt").read_text() == "ALPHA"
    assert state(project)[f"count/{long[0]}"] == "current" and "AssertionError" in capsys.readouterr().err
    assert len(list((project.build / "set" / "errors").iterdir())) == 1
    write(project.root / "stages" / "count.py", toy.COUNT)
    assert make(project) == 0 and not (project.build / "set" / "errors").exists()
    places = [
        path
        for path in (project.build / "store").rglob("*")
        if "kkk" in str(path) and path.name.startswith("k") is False
    ]
    assert places == []


def test_a_failing_step_holds_up_only_what_needs_it(project, capsys):
    write(project.root / "data" / "set" / "a.txt", "bad")
    write(project.root / "data" / "set" / "c.txt", "Gamma")
    assert make(project) == 1
    said = capsys.readouterr()
    assert (
        "upper/a: a.txt: line 1: a bad word" in said.err
        and "use a better one" in said.err
        and "Traceback" not in said.err
    )
    assert ran(project)[-2:] == ["upper/c", "count/c"] and state(project)["count/c"] == "current"
    assert not (project.build / "set" / "upper" / "a.txt").exists(), "a result that is not current is shown"
    write(project.root / "data" / "set" / "a.txt", "good")
    assert new_runs(project) == ["count/a", "total", "upper/a"]


def test_a_defect_leaves_its_traceback_in_a_file(project, capsys):
    write(project.root / "stages" / "table.py", toy.TABLE.replace("json.dumps(params.scale)", "json.dumps(1 / 0)"))
    assert make(project) == 1
    said = capsys.readouterr().err
    assert "table: ZeroDivisionError" in said and "Traceback" not in said
    assert "1 / 0" in (project.build / "set" / "errors" / "table.txt").read_text()


def test_a_stage_that_does_not_keep_its_word_fails(project, capsys):
    write(project.root / "pipeline.yaml", toy.PIPELINE.replace("[total.txt]", "[total.txt, more.txt]"))
    assert make(project) == 1 and "more.txt" in capsys.readouterr().err


def test_a_worker_that_dies_fails_its_step_and_the_next_run_resumes(project, capsys):
    write(project.root / "stages" / "table.py", toy.TABLE.replace("    (out", "    import os; os.abort()\n    (out"))
    assert make(project) == 1 and "process died" in capsys.readouterr().err
    write(project.root / "stages" / "table.py", toy.TABLE)
    assert new_runs(project) == []


def test_warnings_are_said_once_and_kept(project, capsys):
    write(project.root / "data" / "set" / "a.txt", "odd")
    assert make(project) == 0
    assert capsys.readouterr().err.count("a is odd") == 1
    assert verbs.show_status(project, verbs.Wish("set")) == 0
    assert "a is odd" in capsys.readouterr().out


def test_a_moved_checkout_keeps_its_keys(project, tmp_path):
    moved = tmp_path / "elsewhere"
    shutil.move(project.root, moved)
    assert set(state(toy.toy(moved)).values()) == {"current"}
    assert (moved / "build" / "set" / "total" / "total.txt").read_text() == "total: 18"


def test_another_directory_gives_the_same_bytes(project, tmp_path):
    other = make_project(tmp_path / "other")
    assert make(other) == 0
    for stage in ("upper", "count", "table"):
        assert files_of(other.build / "set" / stage) == files_of(project.build / "set" / stage)
    assert {p.name for p in (other.build / "store" / "trees").iterdir()} == {
        p.name for p in (project.build / "store" / "trees").iterdir()
    }


def test_datasets_share_what_is_the_same(project):
    shutil.copytree(project.root / "data" / "set", project.root / "data" / "again")
    assert set(state(project, "again").values()) == {"current"}
    assert make(project, "again") == 0
    assert (project.build / "again" / "total" / "total.txt").exists()


def test_two_folders_of_one_name_are_refused(project, tmp_path):
    shutil.copytree(project.root / "data" / "set", tmp_path / "else" / "set")
    with pytest.raises(InputError, match="two datasets are called 'set'"):
        make(project, str(tmp_path / "else" / "set"))
    assert make(project, str(project.root / "data" / "set")) == 0  # the same one by its path


@pytest.mark.parametrize("name", ["studies", "bench", "store"])
def test_reserved_names(project, name):
    shutil.copytree(project.root / "data" / "set", project.root / "data" / name)
    with pytest.raises(InputError, match=name):
        make(project, name)


def test_an_unknown_dataset(project):
    write(project.root / "data" / "set" / "dataset.yaml", "")
    with pytest.raises(InputError, match="no dataset 'sett'") as caught:
        make(project, "sett")
    assert "did you mean 'set'" in caught.value.cure


def test_gc_keeps_what_is_current_and_only_that(project):
    make(project, settings=["table.scale=3"])
    make(project)
    before = {stage: files_of(project.build / "set" / stage) for stage in ("upper", "count", "table", "total")}
    assert collect(project).results == 2  # table and total of the other scale
    assert {stage: files_of(project.build / "set" / stage) for stage in before} == before
    assert (
        set(state(project).values()) == {"current"} and state(project, settings=("table.scale=3",))["table"] == "to run"
    )
    assert collect(project).results == 0


def test_gc_shows_what_it_would_free_by_stage_and_age_and_asks(project, capsys):
    make(project, settings=["table.scale=3"])
    make(project)
    table = (
        project.build
        / "store"
        / "trees"
        / next(e for e in entries(project) if e.record["stage"] == "table" and "3" in str(e.record)).output
    )
    for key in (project.build / "store" / "keys").iterdir():
        os.utime(key, (time.time() - 3 * 86400 - 60,) * 2)
    capsys.readouterr()
    assert verbs.collect(project, lambda: False) == 0
    said = capsys.readouterr().out
    assert re.search(r"^table +1 result .* MB   3 days old$", said, re.M) and re.search(
        r"^total +1 result ", said, re.M
    )
    assert "nothing was deleted" in said and table.exists()
    assert (
        verbs.collect(project, lambda: True) == 0
        and "deleted 2 results" in capsys.readouterr().out
        and not table.exists()
    )
    assert verbs.collect(project, pytest.fail) == 0  # nothing is asked where there is nothing to free


def entries(project):
    store = Store(project.build / "store")
    return [store.entry(path.stem) for path in store.keys.iterdir()]


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


def heed_interrupts():
    """A shell hands SIGINT down as ignored to what it runs in the background, this test perhaps."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def background(project, *settings):
    command = [sys.executable, toy.__file__, str(project.root), "set", *settings]
    environment = {**os.environ, "PYTHONPATH": str(LIBRARY)}
    return subprocess.Popen(
        command,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        preexec_fn=heed_interrupts,
    )


def wait_until(true, seconds=20):
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end, "it never came to that"
        time.sleep(0.02)


def children_of(parent):
    return [
        int(stat.parent.name) for stat in Path("/proc").glob("[0-9]*/stat") if fields_of(stat)[1:2] == [str(parent)]
    ]


def is_alive(pid):
    return fields_of(Path(f"/proc/{pid}/stat"))[:1] not in ([], ["Z"])


def fields_of(stat):
    """State, parent, … of a process; nothing of one that is gone."""
    try:
        return stat.read_text().rpartition(")")[2].split()
    except OSError:
        return []


def sleepers(project):
    return list((project.build / "store" / "tmp").glob("run-*/upper-*/a.txt"))


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks for processes in /proc")
def test_a_killed_run_leaves_nothing_half_made_and_resumes(project):
    process = background(project, "upper.sleep=30")
    wait_until(lambda: sleepers(project))
    workers = children_of(process.pid)
    process.send_signal(signal.SIGKILL)
    process.wait()
    process.stdout.close()
    assert workers
    wait_until(lambda: not any(is_alive(pid) for pid in workers))
    assert state(project, settings=("upper.sleep=30",))["upper/a"] == "to run"
    assert set(state(project).values()) == {"current"}
    collect(project)  # sweeps what the dead run left
    assert not list((project.build / "store" / "tmp").iterdir())
    assert new_runs(project, settings=["upper.sleep=0.01"]) == ["upper/a", "upper/b"]


def test_the_second_of_two_runs_waits_and_takes_the_firsts_result(project):
    go = project.root / "go"
    toy.wait_for(project, go)
    first = background(project)
    wait_until(lambda: sleepers(project))
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
    wait_until(lambda: sleepers(project))
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


def test_status_shows_what_runs(project, capsys):
    process = background(project, "upper.sleep=30")
    wait_until(lambda: sleepers(project))
    verbs.show_status(project, verbs.Wish("set", settings=["upper.sleep=30"]))
    process.kill()
    process.communicate()
    assert "2 running" in capsys.readouterr().out


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
    write(
        project.root / "stages" / "table.py",
        toy.TABLE.replace(
            "(out /",
            'note = inputs.unfinished / "n"\n    note.parent.mkdir(parents=True, exist_ok=True)\n    seen = note.exists()\n    note.write_text("half")\n    if not seen:\n        raise RuntimeError("killed")\n    (out /',
            1,
        ),
    )
    assert make(project) != 0
    assert len(list((project.build / "store" / "unfinished").iterdir())) == 1
    assert make(project) == 0
    assert not list((project.build / "store" / "unfinished").iterdir())


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
    assert (giving.build / "set" / "total" / "total.txt").read_text() == "total: 45"
    shutil.copytree(tmp_path / "one", tmp_path / "other")
    write(tmp_path / "other" / "more.txt", "not read")
    assert new_runs(giving, settings=named("other")) == []
    write(tmp_path / "other" / "seed.txt", "6")
    assert reasons(giving, "table", settings=named("other")) == ["given file start/seed.txt: changed"]
    assert new_runs(giving, settings=named("other")) == ["table", "total"]
    assert new_runs(giving) == [] and (giving.build / "set" / "total" / "total.txt").read_text() == "total: 18", (
        "it is off unless named"
    )


def test_no_path_of_a_given_folder_is_in_the_key(giving, tmp_path):
    make(giving, settings=[f"table.start={tmp_path / 'one'}"])
    assert str(tmp_path) not in "".join(path.read_text() for path in (giving.build / "store" / "keys").iterdir())


@pytest.mark.parametrize("folder, words", [("nowhere", "no such folder"), (".", "no readable 'seed.txt'")])
def test_a_given_folder_that_is_not_there_is_refused_before_anything_runs(giving, tmp_path, folder, words):
    with pytest.raises(InputError) as caught:
        make(giving, settings=[f"table.start={tmp_path / folder}"])
    said = str(caught.value)
    assert (
        words in said and "table.start" in said and "name a folder with seed.txt" in said and str(tmp_path.name) in said
    )


def test_a_given_file_that_changes_while_it_is_read_is_no_result(giving, tmp_path):
    text = (giving.root / "stages" / "table.py").read_text().rstrip("\n")
    write(giving.root / "stages" / "table.py", text + '\n    (inputs["start"] / "seed.txt").write_text("9")\n')
    assert make(giving, settings=[f"table.start={tmp_path / 'one'}"]) == 1


def test_a_given_folder_that_is_no_path_is_refused(giving):
    with pytest.raises(InputError, match="no such folder"):
        make(giving, settings=["table.start=3"])
