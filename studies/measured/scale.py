"""How runs grow on a cluster: `make results ONLY=scale` sends the sets of `studies/scenes/balls.py` through masks, align, urm and solve.

A Dask scheduler and two workers of one core are started on this machine, each a process of its own over TCP.  Measured are processor
seconds and peak memory of steps, workers, scheduler and the run itself, how many tasks there were and what travelled.  The first size runs
in this machine's processes too, and every byte is compared.  Processor seconds do not depend on what else the machine does.

`python -m studies.measured.scale FOLDER BUILD [setting …]` runs the stages up to `solve` on the data set in FOLDER with a store of its own in BUILD, so
that all is made anew and no user's result is touched.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import psutil

from factorlib.errors import InputError
from factorlib.runner import verbs
from factorlib.runner.cluster import QUIET
from factorlib.runner.project import Project, photo_sets
from studies.measured.tools import ROOT, Tables, exact
from studies.scenes.balls import write_set

FOLDER = ROOT / "build" / "bench" / "scale"
SIZES, MANY, MATERIALS, WORKERS = (50, 1000), 100_000, 100, 2
# At most 12 lobes a light, inserted at once; nothing that the set has not (shadows, light between surfaces, tone curves).
SETTINGS = (
    "urm.directions=0 solve.solver=few_lobes solve.lobes=12 solve.insert=12 solve.rounds=1 solve.iterations=5 solve.polish=0 "
    "solve.settle=0 solve.sample=400 solve.specular=on"
)
ROLES = {  # word of the command line -> what the process is for; the first that fits
    "dask_scheduler": "scheduler",
    "factorlib.runner.child": "steps",
    "dask_worker": "workers",
    "spawn_main": "workers",
    "resource_tracker": "workers",
    "studies.measured.scale": "run",
}


class Cost(msgspec.Struct):
    """cpu_seconds: of all processes of a role;  peak_mb: of the largest one;  processes: how many there were"""

    cpu_seconds: float = 0.0
    peak_mb: float = 0.0
    processes: int = 0


def watched(command: list[str]) -> tuple[int, dict[str, Cost]]:
    """Run a command; its exit code, and what it and this process's other offspring cost by role: read from /proc twice a second."""
    run, looks, costs = subprocess.Popen(command, cwd=ROOT), {}, {}
    while run.poll() is None:
        for process in psutil.Process().children(recursive=True):
            with contextlib.suppress(psutil.Error, OSError, LookupError):
                words, cpu = " ".join(process.cmdline()), process.cpu_times()
                peak = Path(f"/proc/{process.pid}/status").read_text().partition("VmHWM:")[2].split()[0]
                role = next((role for word, role in ROLES.items() if word in words), "other")
                looks[process.pid] = role, cpu.user + cpu.system, int(peak) / 1024
        time.sleep(0.5)
    for role, cpu, peak in looks.values():
        cost = costs.get(role, Cost())
        costs[role] = Cost(cost.cpu_seconds + cpu, max(cost.peak_mb, peak), cost.processes + 1)
    return run.returncode, costs


class Measured(msgspec.Struct):
    """One size.  costs: by role;  stages: by name;  spread: of the solve's blocks;  store_mb, store_files: of the store"""

    photos: int
    costs: dict[str, Cost]
    stages: dict[str, Cost]
    spread: dict[str, float]
    store_mb: float
    store_files: int
    same_bytes: bool | None = None


def measured(folder: Path, build: Path, settings: list[str]) -> Measured:
    """A run from nothing, and what it cost.  InputError where it fails."""
    shutil.rmtree(build, ignore_errors=True)
    command = [sys.executable, "-m", "studies.measured.scale", str(folder), str(build), SETTINGS, *settings]
    code, costs = watched(command)
    if code:
        raise InputError("the run failed: see above", file=folder)
    events = [json.loads(line) for line in (build / folder.name / "log.jsonl").read_text().splitlines()]
    done: dict[str, list[dict[str, Any]]] = {}
    for event in (event for event in events if event["event"] == "done"):
        done.setdefault(event["stage"], []).append(event)
    stages = {}
    for name, of in done.items():
        cpu, memory = zip(*((one["cpu_seconds"], one["memory_mb"]) for one in of), strict=True)
        stages[name] = Cost(sum(cpu), max(memory), len(of))
    sizes = [path.stat().st_size for path in (build / "store").rglob("*") if path.is_file()]
    spread = done["solve"][0].get("spread", {"tasks": 0})
    return Measured(len(done["urm"]), costs, stages, spread, sum(sizes) / 2**20, len(sizes))


@contextlib.contextmanager
def cluster(logs: Path) -> Iterator[str]:
    """A scheduler and workers of one core each; the scheduler's address."""
    logs.mkdir(parents=True, exist_ok=True)
    with contextlib.ExitStack() as ends:

        def started(name: str, pattern: str, *words: str) -> str:
            """What the log of a process says that ends with the cluster."""
            log, end = logs / f"{name}.log", time.monotonic() + 120
            stream = ends.enter_context(open(log, "wb"))
            command, variables = [sys.executable, "-m", *words], {**QUIET, **os.environ}
            process = subprocess.Popen(command, cwd=ROOT, stdout=stream, stderr=stream, env=variables)
            ends.callback(process.wait)
            ends.callback(process.terminate)
            while not (line := re.search(pattern, log.read_text())):
                if time.monotonic() > end:
                    raise InputError("it did not start within two minutes", file=log)
                time.sleep(0.1)
            return line[1]

        options = ("--host", "127.0.0.1", "--port", "0", "--no-dashboard")
        address = started("scheduler", r"Scheduler at:\s+(tcp://\S+)", "distributed.cli.dask_scheduler", *options)
        for number in range(WORKERS):
            words = ("factorlib", "worker", address, "--cores", "1", "--local-directory", str(logs))
            started(f"worker-{number}", r"(Registered to):", *words)
        yield address


def of_size(photos: int, compare: bool) -> Measured:
    """Measure the set of so many photos on a cluster; compare: with the bytes of a run in this machine's processes."""
    folder = FOLDER / "sets" / f"scale-{photos}-{MATERIALS}"
    if not (folder / "dataset.yaml").is_file():
        write_set(folder, photos, MATERIALS)
    builds = [FOLDER / "stores" / f"{folder.name}.{name}" for name in ("cluster", "processes")]
    with cluster(FOLDER / "logs") as scheduler:
        found = measured(folder, builds[0], ["executor=dask", f"scheduler={scheduler}"])
    if compare:
        measured(folder, builds[1], [])
        here, there = ({p.name: p.read_bytes() for p in (b / "store" / "keys").iterdir()} for b in builds)
        found.same_bytes = here == there  # a key's record has the hash of every file
    return found


LINES: dict[str, Callable[[Measured], float]] = {
    "steps": lambda m: sum(stage.processes for stage in m.stages.values()),
    "masks, align, urm: processor s": lambda m: sum(m.stages[k].cpu_seconds for k in ("masks", "align", "urm")),
    "solve: processor s": lambda m: m.stages["solve"].cpu_seconds,
    "of these in blocks": lambda m: m.spread["cpu_seconds"],
    "solve: peak memory of its process, MB": lambda m: m.stages["solve"].peak_mb,
    "of a block's process, MB": lambda m: m.spread["memory_mb"],
    "Dask tasks (steps, and pieces of blocks)": lambda m: LINES["steps"](m) + m.spread["tasks"],
    "scheduler: processor s": lambda m: m.costs["scheduler"].cpu_seconds,
    "workers' own: processor s": lambda m: m.costs["workers"].cpu_seconds,
    "the run's own: processor s": lambda m: m.costs["run"].cpu_seconds,
    "all: processor s": lambda m: sum(cost.cpu_seconds for cost in m.costs.values()),
    "scheduler's memory, MB": lambda m: m.costs["scheduler"].peak_mb,
    "a worker's own memory, MB": lambda m: m.costs["workers"].peak_mb,
    "the run's memory, MB": lambda m: m.costs["run"].peak_mb,
    "sent to blocks, MB: once": lambda m: m.spread["bytes_shelved"] / 2**20,
    "each time, all maps together": lambda m: m.spread["bytes_sent"] / 2**20,
    "back from blocks, MB": lambda m: m.spread["bytes_back"] / 2**20,
    "store, MB": lambda m: m.store_mb,
    "files in the store": lambda m: m.store_files,
}


def rows() -> Tables:
    """The sizes that are measured, and beside them `MANY` photos by the straight line through both."""
    small, large = (of_size(photos, compare=photos == SIZES[0]) for photos in SIZES)
    lines, more = [], (MANY - large.photos) / (large.photos - small.photos)
    for name, of in LINES.items():
        few, many = of(small), of(large)
        lines.append([name, exact(few, 3), exact(many, 3), exact(many + more * (many - few))])
    head = ["photos", str(small.photos), str(large.photos), f"{MANY:,}, worked out"]
    same = ["bytes as in processes of this machine", "yes" if small.same_bytes else "**NO**", "not compared", ""]
    return {"One scheduler, two workers": [head, *lines, same]}


class Elsewhere(Project, frozen=True):
    """The checkout, its results in another folder."""

    results: Path = Path()

    @property
    def build(self) -> Path:
        """The folder of all results."""
        return self.results


if __name__ == "__main__":
    dataset, build, *settings = sys.argv[1:]
    project = Elsewhere(ROOT, photo_sets(), results=Path(build))
    sys.exit(verbs.make(project, verbs.Wish(dataset, ["solve"], settings)))
