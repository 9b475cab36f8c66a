"""Runs on a real Dask cluster: worker processes of their own over TCP, some of them killed; the bytes are those of a run without one."""

import asyncio
import contextlib
import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import msgspec
import pytest

pytest.importorskip("distributed", reason="make setup EXTRAS=dask")

from factorlib import arithmetic
from factorlib.errors import InputError
from factorlib.runner import blocks, cluster, verbs
from factorlib.runner.blocks import Site
from factorlib.runner.child import TRIM
from factorlib.runner.pipeline import read_pipeline, with_settings
from factorlib.runner.project import LIBRARY
from tests.runner import toy
from tests.runner.clusters import LiveCluster, doing, offspring
from tests.runner.toy import files_of, state, write

pytestmark = pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks for processes in /proc")

PROOF = """
import json, os
import msgspec
class Params(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    pass
def main(params, inputs, out, progress):
    names = [*json.loads(os.environ["PROOF"]), "PYTHONHASHSEED", "OMP_NUM_THREADS"] if "PROOF" in os.environ else []
    (out / "environment.json").write_text(json.dumps({name: os.environ.get(name) for name in names} | {"order": list({"a", "b", "c", "d"})}))
"""
SUMS = """
import json, logging, os, time, uuid
from functools import partial
import msgspec
import numpy as np
from factorlib.errors import InputError
log = logging.getLogger("factorlib.sums")
class Params(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    bad: int = -1
    wait: str = ""
def total(item, bad):
    number, seen = item
    if number == bad:
        raise InputError(f"number {number} is bad", cure="leave it out")
    if number == 3:
        log.warning("number %d is odd", number)
    return number, seen.sum(0), os.environ["OMP_NUM_THREADS"]
def delayed(item, wait):
    if wait:
        open(f"{os.path.dirname(wait)}/{item[0]}-begun-{uuid.uuid4().hex}", "x").close()
    while wait and not os.path.exists(wait):
        time.sleep(0.05)
    return item
def main(params, inputs, out, progress):
    seen = np.random.default_rng(0).normal(size=(12, 1000, 33)).astype(np.float32)
    items = [(k, seen[k, :, ::4]) for k in range(12)]
    for _ in range(3):
        found = inputs.map(partial(total, bad=params.bad), items)
    inputs.map(partial(delayed, wait=params.wait), items)
    factor = float(found[0][1][0])
    scaled = inputs.map(lambda item: item[1] * factor, found)
    (out / "sums.json").write_text(json.dumps([[n, s.tobytes().hex(), threads, v.tobytes().hex()] for (n, s, threads), v in zip(found, scaled)]))
"""
MORE = """  proof: {inputs: [count], threads: 2, makes: [environment.json]}
  sums: {inputs: [upper], cores: all, makes: [sums.json]}
"""
TEXTS = {"a": "Alpha", "b": "Beta", "c": "Gamma", "d": "an odd one"}


@pytest.fixture(scope="module")
def live(tmp_path_factory):
    """Two workers, started in an environment that no step may be computed in."""
    before = {name: os.environ.get(name) for name in ("OMP_NUM_THREADS", "PYTHONHASHSEED", *arithmetic.VARIABLES)}
    os.environ.update({"OMP_NUM_THREADS": "7", "PYTHONHASHSEED": "3"} | dict.fromkeys(arithmetic.VARIABLES, ""))
    try:
        found = LiveCluster(2, tmp_path_factory.mktemp("cluster"))
    finally:
        for name, value in before.items():
            os.environ.pop(name) if value is None else os.environ.update({name: value})
    yield found
    found.close()


@pytest.fixture
def project(tmp_path):
    made = toy.make_project(tmp_path / "root", **TEXTS)
    write(made.root / "stages" / "proof.py", PROOF)
    write(made.root / "stages" / "sums.py", SUMS)
    write(made.root / "pipeline.yaml", toy.PIPELINE + MORE)
    return made


@pytest.fixture
def beside(project, tmp_path):
    """The same project somewhere else, run in this machine's processes."""
    other = toy.copy(project, tmp_path / "beside")
    assert verbs.make(other, verbs.Wish("set")) == 0
    return other


def kept(project):
    """Every result by its key, every byte of every result."""
    store = project.build / "store"
    return files_of(store / "keys") | files_of(store / "trees")


def start(project, *settings):
    command = [sys.executable, toy.__file__, str(project.root), "set", *settings]
    environment = {**os.environ, "PYTHONPATH": str(LIBRARY), "OMP_NUM_THREADS": "1"}
    return subprocess.Popen(
        command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True
    )


def wait_until(true, seconds=120):
    end = time.monotonic() + seconds
    while not (found := true()):
        assert time.monotonic() < end, "it never came to that"
        time.sleep(0.02)
    return found


def events_of(project):
    return [json.loads(line) for line in (project.build / "set" / "log.jsonl").read_text().splitlines()]


def steps_done(project):
    return sorted(
        f"{e['stage']}/{e['photo']}" if e["photo"] else e["stage"] for e in events_of(project) if e["event"] == "done"
    )


# ── the same bytes ───────────────────────────────────────────────────────────────────────────────────────────────────


def test_a_cluster_of_two_gives_the_bytes_and_keys_of_one_process(project, beside, live, capsys):
    assert verbs.make(project, verbs.Wish("set", settings=live.settings)) == 0
    assert kept(project) == kept(beside)
    said = capsys.readouterr()
    assert said.err.count("d is odd") == 1 and said.err.count("number 3 is odd") == 1, (
        "what steps and blocks warn of is not lost"
    )
    assert verbs.make(project, verbs.Wish("set")) == 0 and "nothing to do" in capsys.readouterr().out, (
        "where it ran is in no key"
    )
    cost = next(event for event in events_of(project) if event["event"] == "done" and event["stage"] == "sums")
    assert cost["spread"]["maps"] == 5 and cost["spread"]["tasks"] == 5 * 8 and cost["cores"] == 2
    assert not list((project.build / "store" / "tmp").iterdir()), "something is left behind"


@pytest.mark.long
@pytest.mark.parametrize("workers", [1, 2, 4])
def test_any_number_of_workers_gives_the_same_bytes(project, beside, tmp_path, workers):
    found = LiveCluster(workers, tmp_path)
    try:
        assert verbs.make(project, verbs.Wish("set", settings=found.settings)) == 0
    finally:
        found.close()
    assert kept(project) == kept(beside)


def test_a_cluster_of_this_machine_gives_the_same_bytes(project, beside):
    assert start(project, "executor=dask").wait(300) == 0
    assert kept(project) == kept(beside)


def test_steps_have_the_environment_that_their_bits_ask_for_whatever_the_workers_were_started_in(project, live):
    text = PROOF.replace('json.loads(os.environ["PROOF"])', repr([*arithmetic.VARIABLES, TRIM])).replace(
        'if "PROOF" in os.environ else []', ""
    )
    write(project.root / "stages" / "proof.py", text)
    assert verbs.make(project, verbs.Wish("set", ["proof"], settings=live.settings)) == 0
    found = json.loads((project.build / "set" / "proof" / "environment.json").read_text())
    assert {name: found[name] for name in arithmetic.VARIABLES} == arithmetic.VARIABLES
    assert (found["PYTHONHASHSEED"], found["OMP_NUM_THREADS"]) == ("0", "2")
    assert found[TRIM] is None, "Dask sets it, and large arrays are slow with it"


def test_code_that_was_edited_between_two_runs_is_what_the_same_workers_run(project, live):
    for times, text in (("1", "ALPHA"), ("2", "ALPHAALPHA")):
        write(project.root / "stages" / "upper.py", toy.UPPER.replace("* params.times", f"* {times}"))
        assert verbs.make(project, verbs.Wish("set", ["upper"], settings=live.settings)) == 0
        assert (project.build / "set" / "upper" / "a.txt").read_text() == text


# ── what dies ────────────────────────────────────────────────────────────────────────────────────────────────────────


def waiting_for_a_file(project, tmp_path):
    """Steps of `upper` note each try in a file, and end only once another file is there."""
    go, tries = tmp_path / "go", tmp_path / "tries"
    wait = f"open({str(tries)!r}, 'a').write(inputs.photo)\n    while not __import__('os').path.exists({str(go)!r}): time.sleep(0.05)"
    write(project.root / "stages" / "upper.py", toy.UPPER.replace("time.sleep(params.sleep)", wait))
    return go, tries


def at_work(project, count):
    return len(list((project.build / "store" / "tmp").glob("run-*/upper-*/*.json"))) == count


def of_run(project, pids):
    """Those of the processes that compute for a run of the project."""
    return [pid for pid in pids if doing(pid, "runner.child") and doing(pid, str(project.build))]


def of_live(live, word):
    """Processes of the cluster with a word on their command line."""
    return [pid for process in live.processes for pid in offspring(process.pid) if doing(pid, word)]


@pytest.mark.parametrize("victim", ["worker", pytest.param("child", marks=pytest.mark.long)])
def test_what_is_killed_in_mid_step_costs_that_step_alone_and_the_run_ends_with_the_same_bytes(
    project, live, tmp_path, victim
):
    go, tries = waiting_for_a_file(project, tmp_path)
    other = toy.copy(project, tmp_path / "beside")
    process = start(project, *live.settings)
    wait_until(lambda: at_work(project, 2))
    word = {"worker": "spawn_main", "child": "runner.child"}[victim]
    busy = [pid for pid in of_live(live, word) if of_run(project, [pid, *offspring(pid)])]
    os.kill(busy[0], signal.SIGKILL)
    wait_until(lambda: len(tries.read_text()) == 3)
    go.touch()
    said = process.communicate(timeout=120)[0]
    assert process.returncode == 0 and "error" not in said, said
    assert len(tries.read_text()) == len(TEXTS) + 1, "more than the step that was killed ran again"
    assert len(steps_done(project)) == len(set(steps_done(project))) == 12
    tries.unlink()
    assert verbs.make(other, verbs.Wish("set")) == 0
    assert kept(project) == kept(other)


def test_a_worker_that_is_killed_over_the_blocks_of_a_step_costs_neither_the_step_nor_a_bit(project, live, tmp_path):
    go = tmp_path / "go"
    kept_lines = [
        line for line in (toy.PIPELINE + MORE).splitlines() if not re.match("  (count|table|total|proof):", line)
    ]
    write(project.root / "pipeline.yaml", "\n".join(kept_lines))
    other = toy.copy(project, tmp_path / "beside")
    process = start(project, *live.settings, f"sums.wait={go}")

    def begun():
        return sorted(int(path.name.partition("-")[0]) for path in tmp_path.glob("*-begun-*"))

    wait_until(lambda: len(begun()) == 2)
    without_step = [pid for pid in of_live(live, "spawn_main") if len(of_run(project, offspring(pid))) == 1]
    assert len(without_step) == 1, "one worker has the step and a block, the other a block"
    os.kill(without_step[0], signal.SIGKILL)
    wait_until(lambda: len(begun()) == 3)
    go.touch()
    said = process.communicate(timeout=180)[0]
    assert process.returncode == 0 and "error" not in said, said
    assert len(begun()) == 12 + 1 and len(set(begun())) == 12, "more than the block that was killed was begun again"
    assert steps_done(project).count("sums") == 1
    assert verbs.make(other, verbs.Wish("set", settings=[f"sums.wait={go}"])) == 0
    assert kept(project) == kept(other)


def test_a_step_whose_process_dies_each_time_fails_as_one_and_says_so(project, live, capsys):
    write(
        project.root / "stages" / "count.py",
        toy.COUNT.replace("    (out", "    __import__('os').kill(__import__('os').getpid(), 9)\n    (out", 1),
    )
    assert verbs.make(project, verbs.Wish("set", ["count", "table"], settings=live.settings)) == 1
    said = capsys.readouterr().err
    assert said.count("its process died") == len(TEXTS) and "defect" not in said
    assert state(project)["table"] == "current"


@pytest.mark.parametrize(
    "number", [signal.SIGINT, *(pytest.param(n, marks=pytest.mark.long) for n in (signal.SIGTERM, signal.SIGKILL))]
)
def test_a_run_that_is_stopped_leaves_no_step_running_and_the_cluster_to_others(project, live, tmp_path, number):
    go, _ = waiting_for_a_file(project, tmp_path)
    process = start(project, *live.settings)
    wait_until(lambda: at_work(project, 2))
    computing = [pid for process in live.processes for pid in of_run(project, offspring(process.pid))]
    assert len(computing) == 2
    process.send_signal(number)
    said = process.communicate(timeout=120)[0]
    assert process.returncode == (-9 if number == signal.SIGKILL else 128 + number)
    wait_until(lambda: not any(Path(f"/proc/{pid}").exists() for pid in computing), seconds=30)
    if number != signal.SIGKILL:
        assert "stopped; what was finished is kept" in said and "Traceback" not in said, said
        assert not list((project.build / "store" / "tmp").iterdir())
    go.touch()
    assert verbs.make(project, verbs.Wish("set", settings=live.settings)) == 0


# ── what blocks say ──────────────────────────────────────────────────────────────────────────────────────────────────


def test_the_first_block_that_fails_is_the_steps_error(project, live, capsys):
    assert verbs.make(project, verbs.Wish("set", ["sums"], settings=[*live.settings, "sums.bad=7"])) == 1
    said = capsys.readouterr().err
    assert "error: sums: number 7 is bad\n  leave it out" in said and "defect" not in said


def test_pieces_have_all_items_once_in_their_order():
    for count in range(12):
        pieces = blocks._pieces(list(range(count)), 4)
        assert (
            [k for piece in pieces for k in piece] == list(range(count))
            and all(pieces)
            and len(pieces) == min(count, 4)
        )


# ── what is refused ──────────────────────────────────────────────────────────────────────────────────────────────────


def test_a_worker_that_does_not_say_how_many_cores_it_has_is_refused_with_the_command_that_starts_one(project, live):
    started = live._start("plain", "distributed.cli.dask_worker", live.address, "--nthreads", "1", "--no-dashboard")
    try:
        live._said("plain", r"(Registered to):\s")
        with pytest.raises(InputError) as refused:
            verbs.make(project, verbs.Wish("set", settings=live.settings))
    finally:
        os.killpg(started.pid, signal.SIGTERM)
        started.wait(60)
    assert "does not say how many cores" in str(refused.value) and f"-m factorlib worker {live.address}" in str(
        refused.value
    )
    assert not list((project.build / "store" / "tmp").iterdir())


@pytest.mark.parametrize(
    "change, found, cure",
    [
        ({"mark": Path("/nowhere/mark")}, "does not see the run's folder", "mount at the same path"),
        (
            {"library": Path("/other")},
            f"runs the code in {LIBRARY}",
            "cd /other && .venv/bin/python -m factorlib worker",
        ),
        ({"python": "3.99"}, "the run has 3.99", "-m factorlib worker"),
    ],
)
def test_a_worker_elsewhere_is_refused(tmp_path, change, found, cure):
    write(tmp_path / "mark", "")
    good = Site(tmp_path, tmp_path / "mark")
    good.check({"package:msgspec": msgspec.__version__})
    with pytest.raises(InputError) as refused:
        msgspec.structs.replace(good, **change).check()
    assert found in str(refused.value) and cure in str(refused.value)


@pytest.mark.parametrize("package, has", [("msgspec", msgspec.__version__), ("nosuch", "none")])
def test_a_worker_with_another_version_of_what_a_step_imports_is_refused(tmp_path, package, has):
    write(tmp_path / "mark", "")
    with pytest.raises(InputError, match=f"has {package} {has}, the run has 0.0"):
        Site(tmp_path, tmp_path / "mark").check({f"package:{package}": "0.0", "param:a": 1})


def test_without_dask_the_cure_names_the_extra(project, monkeypatch):
    monkeypatch.setattr(cluster, "find_spec", lambda name: None)
    with pytest.raises(InputError, match="EXTRAS=dask"):
        verbs.make(project, verbs.Wish("set", settings=["executor=dask"]))
    with pytest.raises(InputError, match="EXTRAS=dask"):
        cluster.start_worker("tcp://127.0.0.1:1", None, [])


@pytest.mark.parametrize("notebook", [False, True], ids=["a script", "a notebook, whose event loop runs"])
def test_a_scheduler_that_does_not_answer_is_named(project, monkeypatch, notebook):
    monkeypatch.setattr(cluster, "PATIENCE", 0.3)
    if notebook:
        asyncio.run(_refused(project))
    else:
        refuse(project)


async def _refused(project):
    refuse(project)


def refuse(project):
    with pytest.raises(InputError, match=r"no Dask scheduler answers at tcp://127.0.0.1:9") as refused:
        verbs.make(project, verbs.Wish("set", settings=["executor=dask", "scheduler=tcp://127.0.0.1:9"]))
    assert "dask scheduler --port" in str(refused.value) and "event loop" not in str(refused.value)


@pytest.mark.parametrize("greeting", [b"", b"HTTP/1.0 400 Bad request\r\n\r\n"], ids=["silence", "an HTTP server"])
def test_what_listens_and_is_no_scheduler_is_named_and_not_waited_for(project, monkeypatch, greeting):
    monkeypatch.setattr(cluster, "PATIENCE", 1)
    with socket.create_server(("127.0.0.1", 0)) as server:
        held = []

        def answer():
            """Greet whoever comes, and say nothing more."""
            with contextlib.suppress(OSError):
                while True:
                    held.append(server.accept()[0])
                    held[-1].sendall(greeting)

        threading.Thread(target=answer, daemon=True).start()
        began = time.monotonic()
        with pytest.raises(InputError, match="no Dask scheduler answers at"):
            verbs.make(
                project,
                verbs.Wish("set", settings=["executor=dask", f"scheduler=tcp://127.0.0.1:{server.getsockname()[1]}"]),
            )
        assert time.monotonic() - began < 10
        for one in held:
            one.close()


def test_a_worker_is_not_started_for_what_is_no_address():
    with pytest.raises(InputError, match="'10.0.0.1' is no address"):
        cluster.start_worker("10.0.0.1", None, [])


@pytest.mark.long
def test_a_run_waits_for_the_first_worker_and_says_how_one_is_started(project, beside, tmp_path):
    live = LiveCluster(0, tmp_path)
    try:
        process = start(project, *live.settings)
        said = process.stdout.readline()
        assert "waiting: no worker yet" in said and f"-m factorlib worker {live.address}" in said
        live.add_worker()
        process.communicate(timeout=180)
    finally:
        live.close()
    assert process.returncode == 0 and kept(project) == kept(beside)


PLAIN, ON_DASK = "format: 1\nstages: {}\n", "format: 1\nexecutor: dask\nscheduler: tcp://a:1\nstages: {}\n"


@pytest.mark.parametrize(
    "text, settings, expected",
    [
        (PLAIN, [], ("processes", None)),
        (PLAIN, ["executor=dask"], ("dask", None)),
        (PLAIN, ["executor=dask scheduler=tcp://10.0.0.1:8786"], ("dask", "tcp://10.0.0.1:8786")),
        (ON_DASK, [], ("dask", "tcp://a:1")),
        (ON_DASK, ["scheduler=tls://b:2"], ("dask", "tls://b:2")),
        (ON_DASK, ["scheduler="], ("dask", None)),
        (ON_DASK, ["executor=processes"], ("processes", None)),
    ],
)
def test_where_steps_run_stands_in_pipeline_yaml_and_a_setting_replaces_it(tmp_path, text, settings, expected):
    write(tmp_path / "pipeline.yaml", text)
    found = with_settings(read_pipeline(tmp_path / "pipeline.yaml", ()), settings)
    assert (found.executor, found.scheduler) == expected


@pytest.mark.parametrize(
    "text, settings, said",
    [
        (PLAIN, ["executor=dusk"], "SET executor: there is no executor 'dusk'\n  did you mean 'dask'?"),
        (PLAIN, ["executor="], "there is no executor ''"),
        (PLAIN, ["exectuor=dask"], "'exectuor=dask' is no setting\n  did you mean 'executor'?"),
        (PLAIN, ["scheduler=tcp://a:1"], 'only Dask has a scheduler\n  write SET="executor=dask scheduler=…"'),
        (PLAIN, ["executor=dask scheduler=a:1"], "'a:1' is no address\n  write tcp://<host>:<port>"),
        (
            PLAIN.replace("stages", "executor: dusk\nstages"),
            [],
            "executor: there is no executor 'dusk'\n  did you mean 'dask'?",
        ),
        (
            PLAIN.replace("stages", "scheduler: tcp://a:1\nstages"),
            [],
            "scheduler: only Dask has a scheduler\n  add executor: dask",
        ),
        (PLAIN.replace("stages", "executer: dask\nstages"), [], "did you mean 'executor'?"),
    ],
)
def test_what_is_no_executor_is_refused_with_what_was_meant(tmp_path, text, settings, said):
    write(tmp_path / "pipeline.yaml", text)
    with pytest.raises(InputError) as refused:
        with_settings(read_pipeline(tmp_path / "pipeline.yaml", ()), settings)
    assert said in str(refused.value)
