"""The toy, its files written in small pieces; ways to run it, kill it and see what is left."""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from factorlib import __main__ as command_line
from factorlib.runner import verbs
from factorlib.runner.project import LIBRARY, Project
from tests.runner import toy
from tests.runner.toy import files_of, make_project, write

STAGES = ("upper", "count", "table", "total")
SLOWLY = '''
import os, time
def write(path, text):
    """In eight pieces; how long each takes is no part of what is written."""
    with open(path, "w") as stream:
        for k in range(8):
            stream.write(text[k * len(text) // 8 : (k + 1) * len(text) // 8])
            stream.flush()
            time.sleep(float(os.environ.get("TOY_PAUSE", "0")))
'''
PAUSE = 0.008  # seconds for a piece, where something is to happen meanwhile
COMMAND = (  # `python -m factorlib` on the toy in the folder that is the first word
    "import sys; from pathlib import Path; from factorlib import __main__ as line; from tests.runner import toy;"
    "root = Path(sys.argv.pop(1)); line.project = lambda: toy.toy(root); line.main()"
)


def slow_project(root: Path) -> Project:
    """The toy with stages that write slowly where TOY_PAUSE says so."""
    made = make_project(root, a="Alpha " * 50, b="Beta " * 50)
    write(root / "toylib" / "slowly.py", SLOWLY)
    for name in STAGES:
        text = getattr(toy, name.upper())
        slow = re.sub(r"\(out / (.+?)\)\.write_text\((.*)\)$", r"write(out / \1, \2)", text, flags=re.MULTILINE)
        slow = slow.replace("import msgspec\n", "import msgspec\nfrom toylib.slowly import write\n", 1)
        write(root / "stages" / f"{name}.py", slow)
    return made


# ── runs ─────────────────────────────────────────────────────────────────────────────────────────────────────────────


def make(project: Project, *settings: str, targets: list[str] | None = None, force: bool = False) -> int:
    return verbs.make(project, verbs.Wish("set", targets, list(settings), force))


def call(project: Project, *words: str) -> int | str:
    """What `python -m factorlib` with these words ends with: an exit code, or its last words."""
    with pytest.MonkeyPatch.context() as patch, pytest.raises(SystemExit) as caught:
        patch.setattr(command_line, "project", lambda: project)
        patch.setattr(sys, "argv", ["factorlib", *words])
        command_line.main()
    return caught.value.code


def start(project: Project, *settings: str, **environment: str) -> subprocess.Popen:
    """A run as a user starts it, in a group of processes of its own, writing slowly."""
    words = [sys.executable, toy.__file__, str(project.root), "set", *settings]
    set_ = {**os.environ, "PYTHONPATH": str(LIBRARY), "TOY_PAUSE": str(PAUSE), "PYTHONDONTWRITEBYTECODE": "1"}
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    return subprocess.Popen(words, env=set_ | environment, start_new_session=True, **pipes)


def wait_until(true, seconds=60, every=0.001):
    """What a function returns once that is true, or False after so many seconds."""
    end = time.monotonic() + seconds
    while not (value := true()):
        if time.monotonic() > end:
            return False
        time.sleep(every)
    return value


def half_written(project: Project) -> set[str]:
    """Stages of which a step has begun to write files that are no result yet."""
    stages = set()
    with contextlib.suppress(OSError):  # a run sweeps meanwhile
        for path in (project.build / "store" / "tmp").glob("run-*/*/*"):
            stages.add(path.parent.name.partition("-")[0])
    return stages


def members(group: int) -> list[int]:
    """Processes of a group that are not yet dead."""
    pids = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            state, _, of = stat.read_text().rpartition(")")[2].split()[:3]
            if of == str(group) and state != "Z":
                pids.append(int(stat.parent.name))
    return sorted(pids)


def workers(group: int) -> list[int]:
    """Processes of a run that are at work on a step."""
    pids = []
    for pid in members(group):
        with contextlib.suppress(OSError):
            if b"runner.child" in Path(f"/proc/{pid}/cmdline").read_bytes():
                pids.append(pid)
    return pids


def end(process: subprocess.Popen) -> int:
    """The exit code of a run; none of its processes is left."""
    process.communicate(timeout=120)
    assert wait_until(lambda: not members(process.pid), every=0.02)
    return process.returncode


def kill(process: subprocess.Popen, whom: str) -> None:
    """SIGKILL to all processes of a run, to the run alone, or to one that is at work on a step."""
    with contextlib.suppress(ProcessLookupError):
        if whom == "all of its processes":
            os.killpg(process.pid, signal.SIGKILL)
        elif whom == "the run":
            os.kill(process.pid, signal.SIGKILL)
        elif pids := workers(process.pid):
            os.kill(pids[-1], signal.SIGKILL)


# ── what is there afterwards ─────────────────────────────────────────────────────────────────────────────────────────


def results(project: Project) -> dict[str, bytes]:
    """What stands under the data set's name, but for the log of runs; drafts of a writer that was killed are hidden."""
    files = files_of(project.build / "set")
    return {k: v for k, v in files.items() if k != "log.jsonl" and not k.startswith(("errors/", "."))}


def kept(project: Project) -> dict[str, str]:
    """Step by key, of every result in the store."""
    steps, store = {}, project.build / "store"
    for path in (store / "keys").glob("*.json"):
        entry = json.loads(path.read_bytes())
        if (store / "trees" / entry["output"]).is_dir():
            steps[path.stem] = "/".join(filter(None, (entry["record"]["stage"], entry["record"]["photo"])))
    return steps


def done(project: Project) -> list[str]:
    """The steps that runs say they have done, in order."""
    log = project.build / "set" / "log.jsonl"
    events = [json.loads(line) for line in log.read_text().splitlines()] if log.exists() else []
    return ["/".join(filter(None, (e["stage"], e["photo"]))) for e in events if e["event"] == "done"]


def new_runs(project: Project, *settings: str) -> list[str]:
    """The steps that the next run does."""
    before = len(done(project))
    assert make(project, *settings) == 0
    return sorted(done(project)[before:])


def lost_in(project: Project, wanted: dict[str, bytes], *settings: str) -> list[str]:
    """What a fault cost: the next run must be accepted, make only what is missing, and end in the same bytes."""
    losses, before = [], set(kept(project).values())
    if verbs.verify(project, None) != 0:
        losses.append("something that is damaged is taken for a result")
    already = len(done(project))
    if make(project, *settings) != 0:
        losses.append("the next run failed")
    if again := sorted(before & set(done(project)[already:])):
        losses.append(f"made twice: {', '.join(again)}")
    now = results(project)
    if now != wanted:
        names = sorted(name for name in now.keys() | wanted.keys() if now.get(name) != wanted.get(name))
        losses.append(f"other bytes: {names}")
    if verbs.verify(project, None) != 0:
        losses.append("damaged afterwards")
    return losses
