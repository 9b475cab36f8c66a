"""Runs on a real Dask cluster: workers of their own over TCP, some of them killed; the bytes are those of a run without one."""

import contextlib
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import pytest

pytest.importorskip("distributed", reason="make setup EXTRAS=dask")

from factorlib.errors import InputError
from factorlib.runner import worker
from factorlib.runner.project import LIBRARY, read_pipeline, with_settings
from tests.faults.test_kills import start, wait_until
from tests.runner import toy
from tests.runner.toy import files_of, make, write

pytestmark = pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks for processes in /proc")

FIXED = {"PYTHONHASHSEED": "0", "OMP_NUM_THREADS": "2", "MALLOC_TRIM_THRESHOLD_": None}  # of a step of two threads
PROOF = f"""
import json, os
import msgspec
class Params(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    pass
def main(params, inputs, out, progress):
    environment = {{name: os.environ.get(name) for name in {list(FIXED)}}}
    (out / "environment.json").write_text(json.dumps([environment, list({{"a", "b", "c", "d"}})]))
"""
SUMS = """
import json
import msgspec
import numpy as np
class Params(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    pass
def main(params, inputs, out, progress):
    values = np.random.default_rng(0).normal(size=(12, 1000, 33)).astype(np.float32)
    sums = inputs.map(lambda k: values[k, :, ::4].sum(0), range(12))
    (out / "sums.json").write_text(json.dumps([s.tobytes().hex() for s in sums]))
"""
MORE = """  proof: {inputs: [count], threads: 2, makes: [environment.json]}
  sums: {inputs: [upper], cores: all, makes: [sums.json]}
"""
TEXTS = {"a": "Alpha", "b": "Beta", "c": "Gamma", "d": "an odd one"}


class LiveCluster(contextlib.AbstractContextManager):
    """A scheduler in a process of its own, and its workers."""

    def __init__(self, workers: int, folder: Path, environment: dict[str, str] | None = None):
        self.folder, self.environment = folder, environment or {}
        self.processes: list[subprocess.Popen] = []
        options = ["--host", "127.0.0.1", "--port", "0", "--no-dashboard"]
        self.start("distributed.cli.dask_scheduler", *options, says="Scheduler at")
        self.address = re.search(r"tcp://\S+", self.log(0))[0]
        for _ in range(workers):
            self.add_worker()

    def add_worker(self) -> subprocess.Popen:
        """One more, of one core; returns when the scheduler knows it."""
        options = f"--nthreads 1 --host 127.0.0.1 --local-directory {tempfile.gettempdir()}".split()
        return self.start("distributed.cli.dask_worker", self.address, *options, says="Registered to")

    def start(self, *words: str, says: str) -> subprocess.Popen:
        """A process `python -m <words>` that has written `says`, a colon and a word into its log."""
        more = {"PYTHONPATH": str(LIBRARY), "DASK_DISTRIBUTED__COMM__TIMEOUTS__CONNECT": "60s", **self.environment}
        number, end = len(self.processes), time.monotonic() + 120
        with open(self.folder / f"{number}.log", "wb") as log:
            outer = {"env": {**os.environ, **more}, "stdout": log, "stderr": log, "cwd": self.folder}
            self.processes.append(subprocess.Popen([sys.executable, "-m", *words], start_new_session=True, **outer))
        while not re.search(rf"{says}:\s+\S", self.log(number)):
            assert time.monotonic() < end, self.log(number)
            time.sleep(0.05)
        return self.processes[-1]

    def log(self, number: int) -> str:
        return (self.folder / f"{number}.log").read_text()

    @property
    def settings(self) -> list[str]:
        """The words that make a run use it."""
        return [f"executor={self.address}"]

    def kill_workers(self) -> None:
        """SIGKILL to all but the scheduler."""
        while len(self.processes) > 1:
            self._kill(self.processes.pop())

    def close(self) -> None:
        """SIGKILL to all."""
        self.kill_workers()
        self._kill(self.processes[0])

    def _kill(self, process: subprocess.Popen) -> None:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()

    def __exit__(self, *exception: object) -> None:
        self.close()


def started_by(pid: int) -> list[int]:
    """The processes that Python's multiprocessing has started in a process: workers of a nanny, those of steps in a worker."""
    children = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            parent = int(stat.read_text().rpartition(")")[2].split()[1])
            if parent == pid and b"--multiprocessing-fork" in stat.with_name("cmdline").read_bytes():
                children.append(int(stat.parent.name))
    return children


@pytest.fixture(scope="module")
def live(tmp_path_factory):
    """Two workers, started in an environment that no step may be computed in."""
    bad = {"OMP_NUM_THREADS": "7", "PYTHONHASHSEED": "3"}
    with LiveCluster(2, tmp_path_factory.mktemp("cluster"), bad) as made:
        yield made


@pytest.fixture
def project(tmp_path):
    made = toy.make_project(tmp_path / "root", **TEXTS)
    write(made.root / "stages" / "proof.py", PROOF)
    write(made.root / "stages" / "sums.py", SUMS)
    write(made.root / "pipeline.yaml", toy.PIPELINE + MORE)
    return made


def kept(project):
    """Every result by its key, every byte of every result."""
    store = project.build / "store"
    entries = {path.name: json.loads(path.read_text()) for path in (store / "keys").iterdir()}
    return {key: entry | {"cost": None} for key, entry in entries.items()} | files_of(store / "trees")


def beside(project, *settings):
    """What is kept of the same project somewhere else, run in this machine's processes."""
    other = toy.copy(project, project.root.parent / "beside")
    assert make(other, *settings) == 0
    return kept(other)


def ended(process, code=0):
    """What a run said that has ended with that code."""
    text = process.communicate(timeout=180)[0]
    assert process.returncode == code and "Traceback" not in text, text
    return text


def done_of(project):
    lines = (project.build / "set" / "log.jsonl").read_text().splitlines()
    return [event for event in map(json.loads, lines) if event["event"] == "done"]


# ── the same bytes ───────────────────────────────────────────────────────────────────────────────────────────────────


def test_a_cluster_of_two_gives_the_bytes_and_keys_of_one_process(project, live, capsys):
    expected = beside(project)
    capsys.readouterr()
    assert make(project, *live.settings) == 0
    assert kept(project) == expected
    text = capsys.readouterr().err
    assert text.count("d is odd") == 1
    assert make(project) == 0 and "nothing to do" in capsys.readouterr().out, "where it ran is in no key"
    environment = json.loads((project.build / "set" / "proof" / "environment.json").read_text())[0]
    assert environment == FIXED, "whatever the workers were started in"
    assert not list((project.build / "store" / "tmp").iterdir()), "something is left behind"


@pytest.mark.long
@pytest.mark.parametrize("workers", [1, 2, 4])
def test_any_number_of_workers_gives_the_same_bytes(project, tmp_path, workers):
    with LiveCluster(workers, tmp_path) as live:
        assert make(project, *live.settings) == 0
    assert kept(project) == beside(project)


# ── what dies ────────────────────────────────────────────────────────────────────────────────────────────────────────


def waiting_for_a_file(project, tmp_path):
    """Steps of `upper` note each try in a file, and end only once another file is there."""
    go, tries = tmp_path / "go", tmp_path / "tries"
    wait = f"open({str(tries)!r}, 'a').write(inputs.photo)\n    while not __import__('os').path.exists({str(go)!r}): time.sleep(0.05)"
    write(project.root / "stages" / "upper.py", toy.UPPER.replace("time.sleep(params.sleep)", wait))
    return go, tries


def at_work(project, count):
    return len(list((project.build / "store" / "tmp").glob("run-*/upper-*/*.json"))) == count


def busy(live, whose):
    """Of a cluster the workers that compute a step, or the processes of these in which they do."""
    workers = [pid for process in live.processes for pid in started_by(process.pid)]
    computing = {worker: started_by(worker) for worker in workers}
    return [pid for worker, of in computing.items() for pid in ([worker] if whose == "worker" else of) if of]


@pytest.mark.long
@pytest.mark.parametrize("victim", ["worker", "process"])
def test_a_worker_or_child_killed_in_mid_step_costs_that_step_alone_and_no_bit(project, live, tmp_path, victim):
    go, tries = waiting_for_a_file(project, tmp_path)
    process = start(project, *live.settings)
    assert wait_until(lambda: at_work(project, 2))
    os.kill(busy(live, victim)[0], signal.SIGKILL)
    assert wait_until(lambda: len(tries.read_text()) == 3)
    go.touch()
    assert "error" not in ended(process)
    assert len(tries.read_text()) == len(TEXTS) + 1, "more than the step that was killed ran again"
    steps = [(event["stage"], event["photo"]) for event in done_of(project)]
    assert len(steps) == len(set(steps)) == 12
    assert kept(project) == beside(project)


@pytest.mark.parametrize(
    "number", [signal.SIGINT, *(pytest.param(n, marks=pytest.mark.long) for n in (signal.SIGTERM, signal.SIGKILL))]
)
def test_a_run_that_is_stopped_leaves_no_step_running_and_the_cluster_to_others(project, live, tmp_path, number):
    go, _ = waiting_for_a_file(project, tmp_path)
    process = start(project, *live.settings)
    assert wait_until(lambda: at_work(project, 2))
    computing = busy(live, "process")
    assert len(computing) == 2
    process.send_signal(number)
    text = ended(process, -9 if number == signal.SIGKILL else 128 + number)
    assert wait_until(lambda: not any(Path(f"/proc/{pid}").exists() for pid in computing), seconds=30)
    if number != signal.SIGKILL:
        assert "stopped; what was finished is kept" in text
        assert not list((project.build / "store" / "tmp").iterdir())
    go.touch()
    assert make(project, *live.settings) == 0


# ── what is refused ──────────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.long
def test_a_run_whose_workers_are_all_killed_goes_on_when_one_comes(project, live, tmp_path, capsys):
    """The last test of these workers."""
    go, tries = waiting_for_a_file(project, tmp_path)

    def kill_all():
        assert wait_until(lambda: tries.exists() and len(tries.read_text()) == 2)
        live.kill_workers()
        time.sleep(5)
        go.touch()
        live.add_worker()

    thread = threading.Thread(target=kill_all)
    thread.start()
    assert make(project, *live.settings) == 0
    thread.join()
    text = "".join(capsys.readouterr())
    assert text.count("wait there for a worker") == 1 and f".venv/bin/dask worker {live.address}" in text
    assert kept(project) == beside(project)


def test_a_worker_that_does_not_see_the_build_folder_is_refused():
    with pytest.raises(InputError, match="does not see the run's folder") as refused:
        worker.compute_in_process(Path("/nowhere"), 1, abs, -1)
    assert "mount at the same path" in refused.value.cure


def test_without_dask_the_cure_names_the_extra(project, monkeypatch):
    monkeypatch.setattr(worker, "find_spec", lambda name: None)
    with pytest.raises(InputError, match="EXTRAS=dask"):
        make(project, "executor=tcp://127.0.0.1:1")


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:9", "tls://127.0.0.1:9", "ucx://127.0.0.1:9"])
def test_a_scheduler_out_of_reach_is_named(project, monkeypatch, address, capfd):
    monkeypatch.setattr(worker, "PATIENCE", 0.3)
    with pytest.raises(InputError, match=f"no Dask scheduler answers at {address}") as refused:
        make(project, f"executor={address}")
    assert "dask scheduler --port" in str(refused.value) and "Traceback" not in "".join(capfd.readouterr())


PLAIN, ON_DASK = "format: 1\nstages: {}\n", "format: 1\nexecutor: tcp://a:1\nstages: {}\n"


@pytest.mark.parametrize("text, setting, expected", [
    (PLAIN, "", "processes"),
    (PLAIN, "executor=tcp://10.0.0.1:8786", "tcp://10.0.0.1:8786"),
    (ON_DASK, "", "tcp://a:1"),
    (ON_DASK, "executor=processes", "processes"),
    (PLAIN, "executor=dusk", "SET executor=dusk: "),
    (PLAIN, "exectuor=dask", "SET: 'exectuor=dask' is not a setting"),
    ("executor: dusk\n" + PLAIN, "", "pipeline.yaml:1: executor: "),
    ("executer: dask\n" + PLAIN, "", "did you mean 'executor'?"),
])  # fmt: skip
def test_where_steps_run_stands_in_pipeline_yaml_and_a_setting_replaces_it(tmp_path, text, setting, expected):
    write(tmp_path / "pipeline.yaml", text)
    try:
        result = with_settings(read_pipeline(tmp_path / "pipeline.yaml", ()), [setting]).executor
    except InputError as error:
        result = str(error)
    assert expected in result
