"""A project that faults are tried on: the toy, its files written in small pieces, and ways to run it, kill it and look at what is left."""

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

from factorlib.runner import verbs
from factorlib.runner.project import LIBRARY, Project
from factorlib.runner.store import Store
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
PAUSE = "0.008"  # seconds for a piece, where something is to happen meanwhile
TEXTS = {"a": "Alpha " * 50, "b": "Beta " * 50}


def slow_project(root: Path, **texts: str) -> Project:
    """The toy with stages that write slowly where TOY_PAUSE says so."""
    made = make_project(root, **(texts or TEXTS))
    write(root / "toylib" / "slowly.py", SLOWLY)
    for name, text in (("upper", toy.UPPER), ("count", toy.COUNT), ("table", toy.TABLE), ("total", toy.TOTAL)):
        slow = re.sub(r"\(out / (.+?)\)\.write_text\((.*)\)$", r"write(out / \1, \2)", text, flags=re.MULTILINE)
        write(
            root / "stages" / f"{name}.py",
            slow.replace("import msgspec\n", "import msgspec\nfrom toylib.slowly import write\n", 1),
        )
    return made


def start(project: Project, *settings: str, **environment: str) -> subprocess.Popen:
    """A run as a user starts it, in a group of processes of its own, writing slowly."""
    command = [sys.executable, toy.__file__, str(project.root), "set", *settings]
    words = {**os.environ, "PYTHONPATH": str(LIBRARY), "TOY_PAUSE": PAUSE, "PYTHONDONTWRITEBYTECODE": "1"} | environment
    return subprocess.Popen(
        command, env=words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True
    )


def make(project: Project, *settings: str) -> int:
    return verbs.make(project, verbs.Wish("set", settings=list(settings)))


def wait_until(true, seconds=60, every=0.001):
    """Whether it came to that in time."""
    end = time.monotonic() + seconds
    while not (found := true()):
        if time.monotonic() > end:
            return False
        time.sleep(every)
    return found


def half_written(project: Project) -> set[str]:
    """Stages of which a step has begun to write files that are no result yet."""
    found = set()
    with contextlib.suppress(OSError):  # a run sweeps meanwhile
        for path in (project.build / "store" / "tmp").glob("run-*/*/*"):
            found.add(path.parent.name.partition("-")[0])
    return found


def members(group: int) -> list[int]:
    """Processes of a group that are not yet dead."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            state, _, of = stat.read_text().rpartition(")")[2].split()[:3]
            if of == str(group) and state != "Z":
                found.append(int(stat.parent.name))
    return sorted(found)


def workers(group: int) -> list[int]:
    """Processes of a run that are at work on a step."""
    found = []
    for pid in members(group):
        with contextlib.suppress(OSError):
            if b"runner.child" in Path(f"/proc/{pid}/cmdline").read_bytes():
                found.append(pid)
    return found


def end(process: subprocess.Popen) -> int:
    """What a run ends with; none of its processes is left."""
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
        elif found := workers(process.pid):
            os.kill(found[-1], signal.SIGKILL)


def results(project: Project) -> dict[str, bytes]:
    """What a user finds under the data set's name, but for the log of runs; drafts of a writer that was killed are hidden files."""
    return {
        name: data
        for name, data in files_of(project.build / "set").items()
        if name != "log.jsonl" and not name.startswith(("errors/", "."))
    }


def kept(project: Project) -> dict[str, str]:
    """Step by key, of every result that the store has."""
    store = Store(project.build / "store")
    found = {path.stem: store.entry(path.stem) for path in store.keys.glob("*.json")}
    return {key: "/".join(filter(None, (e.record["stage"], e.record["photo"]))) for key, e in found.items() if e}


def done(project: Project) -> list[str]:
    """The steps that runs say they have done, in order."""
    log = project.build / "set" / "log.jsonl"
    events = [json.loads(line) for line in log.read_text().splitlines()] if log.exists() else []
    return ["/".join(filter(None, (e["stage"], e["photo"]))) for e in events if e["event"] == "done"]


def lost_in(project: Project, wanted: dict[str, bytes], *settings: str) -> list[str]:
    """What a fault cost: the next run must be accepted, make what is not there yet and only that, and end in the same bytes."""
    found, before = [], set(kept(project).values())
    if verbs.verify(project, None) != 0:
        found.append("something that is damaged is taken for a result")
    already = len(done(project))
    if make(project, *settings) != 0:
        found.append("the next run failed")
    if again := sorted(before & set(done(project)[already:])):
        found.append(f"made twice: {', '.join(again)}")
    now = results(project)
    if now != wanted:
        found.append(
            f"other bytes: {sorted(name for name in now.keys() | wanted.keys() if now.get(name) != wanted.get(name))}"
        )
    if verbs.verify(project, None) != 0:
        found.append("damaged afterwards")
    return found
