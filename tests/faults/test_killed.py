"""Processes that are killed or asked to end: one costs only its own step, and what was finished is kept."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from factorlib.runner.project import LIBRARY
from tests.runner import toy
from tests.runner.toy import state, write

pytestmark = pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks for processes in /proc")
C_STACK = """
import ctypes, os, signal
libc = ctypes.CDLL(None)
@ctypes.CFUNCTYPE(None, ctypes.c_int)
def _c_stack(number):
    os.write(2, b"*** SIGTERM received by PID 1; stack trace: ***\\n")
    os._exit(1)
libc.signal(signal.SIGTERM, _c_stack)  # what pycolmap does where it is imported
"""


@pytest.fixture
def project(tmp_path):
    return toy.make_project(tmp_path)


def start(project, *settings):
    command = [sys.executable, toy.__file__, str(project.root), "set", *settings]
    environment = {**os.environ, "PYTHONPATH": str(LIBRARY)}
    return subprocess.Popen(
        command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True
    )


def wait_until(true, seconds=60):
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end, "it never came to that"
        time.sleep(0.02)


def workers(parent):
    """Processes that are at work on a step."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            of_parent = (folder / "stat").read_text().rpartition(")")[2].split()[1] == str(parent)
            if of_parent and b"runner.child" in (folder / "cmdline").read_bytes():
                found.append(int(folder.name))
        except OSError:
            continue
    return sorted(found)


def at_work(project, step):
    return list((project.build / "store" / "tmp").glob(f"run-*/{step}/*"))


@pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="one processor runs one step at a time")
def test_a_killed_worker_does_not_fail_the_step_beside_it(project):
    go = project.root / "go"
    toy.wait_for(project, go)
    process = start(project)
    wait_until(lambda: at_work(project, "upper-a") and at_work(project, "upper-b"))
    os.kill(workers(process.pid)[0], signal.SIGKILL)
    go.touch()
    said = process.communicate(timeout=60)[0]
    assert process.returncode == 1 and said.count("process died") == 1 and "1 step failed" in said
    made = state(project)
    assert sorted(made[f"upper/{photo}"] for photo in "ab") == ["current", "to run"]
    events = [json.loads(line) for line in (project.build / "set" / "log.jsonl").read_text().splitlines()]
    assert sum(event["event"] == "done" and event["stage"] == "upper" for event in events) == 1, (
        "the step beside it ran again"
    )


def told_to_end(project, target):
    process = start(project, "upper.sleep=30")
    wait_until(lambda: at_work(project, "upper-a"))
    at_their_work = workers(process.pid)
    os.kill(process.pid if target == "run" else -process.pid, signal.SIGTERM)
    said = process.communicate(timeout=60)[0]
    wait_until(lambda: not any(Path(f"/proc/{pid}").exists() for pid in at_their_work))
    return process.returncode, said


@pytest.mark.parametrize("target", ["run", "all of its processes"])
def test_sigterm_ends_a_run_as_an_interrupt_does(project, target):
    code, said = told_to_end(project, target)
    assert code == 143 and "stopped; what was finished is kept" in said
    assert "Traceback" not in said and "process died" not in said
    assert not list((project.build / "store" / "tmp").iterdir())


@pytest.mark.parametrize("target", ["run", "all of its processes"])
def test_a_library_that_takes_sigterm_prints_no_c_stack(project, target):
    write(project.root / "stages" / "upper.py", toy.UPPER.replace("class Params", C_STACK + "class Params", 1))
    code, said = told_to_end(project, target)
    assert code == 143 and "stack trace" not in said


def test_a_reader_that_takes_sigterm_prints_no_c_stack():
    """pycolmap itself, as reading cameras of a COLMAP model imports it."""
    code = (
        "import os, signal, factorlib.runner.stop as stop\n"
        "with stop.heed_stops():\n"
        "    import pycolmap; stop.take_sigterm_back(); os.kill(os.getpid(), signal.SIGTERM)"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=LIBRARY, capture_output=True, text=True, check=False)
    assert done.returncode == 143 and not done.stderr
