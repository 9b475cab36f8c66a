"""How runs grow: `python -m benchmarks.scale --photos 200` sends a generated set through masks, align, urm and solve on a Dask cluster.

A scheduler and two workers are started on this machine, each a process of its own over TCP.  What is measured goes to
build/bench/scale/<photos>.json: processor seconds and peak memory of the steps, of the workers, of the scheduler and of the run itself,
how many tasks there were and what travelled.  `--beside` runs the same set in this machine's processes too, and compares
every byte.  `--docs` writes the table of all sizes that were measured to docs/distributed.md.

Processor seconds do not depend on what else the machine does; wall seconds do.
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
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import msgspec
import typer

from benchmarks.markdown import ROOT, refresh, table
from benchmarks.rounded import exact
from benchmarks.scale.scenes import write_set
from benchmarks.scale.watch import Cost, Watch
from factorlib.errors import InputError
from factorlib.jsonfile import write_json
from factorlib.runner.cluster import QUIET

FOLDER = ROOT / "build" / "bench" / "scale"
DOCS = ROOT / "docs" / "distributed.md"
# At most 12 lobes a light, inserted at once; nothing that the set has not (shadows, light between surfaces, tone curves).
SETTINGS = (
    "urm.directions=0 solve.solver=few_lobes solve.lobes=12 solve.insert=12 solve.rounds=1 solve.iterations=5 solve.polish=0 solve.settle=0 solve.sample=400 "
    "solve.specular=on"
)
OVERHEAD = ("workers", "scheduler", "run")


class Measured(msgspec.Struct):
    """One size.  stages: by name, steps, and their processor seconds and peak memory;  spread: of the solve's blocks;  costs: by role"""

    photos: int
    materials: int
    workers: int
    wall_seconds: float
    most_mb: float
    costs: dict[str, Cost]
    stages: dict[str, Cost]
    spread: dict[str, float]
    store_mb: float
    store_files: int
    same_bytes: bool | None = None

    @property
    def tasks(self) -> int:
        """Dask tasks: steps, and pieces of blocks."""
        return sum(stage.processes for stage in self.stages.values()) + int(self.spread["tasks"])

    @property
    def overhead_seconds(self) -> float:
        """Processor seconds of what computes nothing."""
        return sum(self.costs[role].cpu_seconds for role in OVERHEAD)


def main(
    photos: Annotated[int, typer.Option(min=5)] = 50,
    materials: Annotated[int, typer.Option(min=5, max=254)] = 100,
    workers: Annotated[int, typer.Option(min=1, max=64)] = 2,
    beside: Annotated[
        bool, typer.Option("--beside", help="run it in this machine's processes too, and compare the bytes")
    ] = False,
    docs: Annotated[
        bool, typer.Option("--docs", help="write the table of what was measured, and measure nothing")
    ] = False,
) -> None:
    """Measure one size, or write the table."""
    if docs:
        sizes = [
            msgspec.json.decode(path.read_bytes(), type=Measured)
            for path in sorted(FOLDER.glob("*.json"), key=lambda path: int(path.stem))
        ]
        line = worked_out(sizes[-2], sizes[-1]) if len(sizes) > 1 else "(One size was measured; a line needs two.)"
        refresh(DOCS, {"scale": rows(sizes), "worked out": line})
        return
    folder = FOLDER / "sets" / f"scale-{photos}-{materials}"
    if not (folder / "dataset.yaml").is_file():
        write_set(folder, photos, materials)
    build = FOLDER / "stores" / folder.name
    with cluster(build.with_name(f"{build.name}.logs"), workers) as scheduler:
        found = measured(folder, build, workers, ["executor=dask", f"scheduler={scheduler}"])
    if beside:
        measured(folder, other := build.with_name(f"{build.name}.beside"), workers, [])
        found.same_bytes = kept(build) == kept(other)
    write_json(FOLDER / f"{photos}.json", found)
    print(json.dumps(msgspec.to_builtins(found), indent=1))


def measured(folder: Path, build: Path, workers: int, settings: list[str]) -> Measured:
    """A run from nothing, and what it cost.  Raises InputError where it fails."""
    shutil.rmtree(build, ignore_errors=True)
    watch, started = Watch(), time.perf_counter()
    command = [sys.executable, "-m", "benchmarks.scale.project", str(folder), str(build), SETTINGS, *settings]
    code = subprocess.run(command, cwd=ROOT, check=False).returncode
    seconds, costs = time.perf_counter() - started, watch.close()
    if code:
        raise InputError("the run failed: see above", file=folder)
    events = [json.loads(line) for line in (build / folder.name / "log.jsonl").read_text().splitlines()]
    done = [event for event in events if event["event"] == "done"]
    files = [path for path in (build / "store").rglob("*") if path.is_file()]
    return Measured(
        photos=sum(event["stage"] == "urm" for event in done),
        materials=int(folder.name.rpartition("-")[2]),
        workers=workers,
        wall_seconds=round(seconds, 1),
        most_mb=round(watch.most_mb),
        costs=costs,
        stages={
            name: _cost([event for event in done if event["stage"] == name])
            for name in dict.fromkeys(event["stage"] for event in done)
        },
        spread=next(event for event in done if event["stage"] == "solve").get("spread", {"tasks": 0}),
        store_mb=round(sum(path.stat().st_size for path in files) / 2**20, 1),
        store_files=len(files),
    )


def _cost(events: list[dict[str, Any]]) -> Cost:
    return Cost(
        round(sum(event["cpu_seconds"] for event in events), 1),
        max(event["memory_mb"] for event in events),
        len(events),
    )


def kept(build: Path) -> dict[str, bytes]:
    """What each key gave: by hash, so that of every byte."""
    return {path.name: path.read_bytes() for path in (build / "store" / "keys").iterdir()}


@contextlib.contextmanager
def cluster(logs: Path, workers: int) -> Iterator[str]:
    """A scheduler and workers of one core each; the scheduler's address."""
    logs.mkdir(parents=True, exist_ok=True)
    with contextlib.ExitStack() as ends:

        def started(name: str, *words: str) -> Path:
            """The log of a process that ends with the cluster."""
            stream = ends.enter_context(open(logs / f"{name}.log", "wb"))
            process = subprocess.Popen(
                [sys.executable, "-m", *words], cwd=ROOT, stdout=stream, stderr=stream, env={**QUIET, **os.environ}
            )
            ends.callback(process.wait)
            ends.callback(process.terminate)
            return logs / f"{name}.log"

        log = started(
            "scheduler", "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard"
        )
        address = _said(log, r"Scheduler at:\s+(tcp://\S+)")
        for number in range(workers):
            log = started(
                f"worker-{number}", "factorlib", "worker", address, "--cores", "1", "--local-directory", str(logs)
            )
            _said(log, r"(Registered to):")
        yield address


def _said(log: Path, pattern: str, patience: float = 120.0) -> str:
    end = time.monotonic() + patience
    while not (found := re.search(pattern, log.read_text())):
        if time.monotonic() > end:
            raise InputError(f"it did not start within {patience:.0f} s", file=log)
        time.sleep(0.1)
    return found[1]


def rows(sizes: list[Measured]) -> str:
    """The table of all sizes that were measured."""
    lines = {
        "steps": lambda m: str(sum(stage.processes for stage in m.stages.values())),
        "masks, align, urm: processor s": lambda m: exact(
            sum(m.stages[name].cpu_seconds for name in ("masks", "align", "urm")), 3
        ),
        "solve: processor s": lambda m: exact(m.stages["solve"].cpu_seconds, 3),
        "of these in blocks": lambda m: exact(m.spread["cpu_seconds"], 3),
        "solve: peak memory of its process, MB": lambda m: exact(m.stages["solve"].peak_mb, 3),
        "of a block's process, MB": lambda m: exact(m.spread["memory_mb"], 3),
        "Dask tasks": lambda m: str(m.tasks),
        "scheduler: processor s": lambda m: exact(m.costs["scheduler"].cpu_seconds, 3),
        "workers' own: processor s": lambda m: exact(m.costs["workers"].cpu_seconds, 3),
        "the run's own: processor s": lambda m: exact(m.costs["run"].cpu_seconds, 3),
        "all three, ms a task": lambda m: exact(1e3 * m.overhead_seconds / m.tasks, 2),
        "all three, of all processor s": lambda m: (
            f"{100 * m.overhead_seconds / sum(c.cpu_seconds for c in m.costs.values()):.1f} %"
        ),
        "scheduler's memory, MB": lambda m: exact(m.costs["scheduler"].peak_mb, 3),
        "a worker's own memory, MB": lambda m: exact(m.costs["workers"].peak_mb, 3),
        "the run's memory, MB": lambda m: exact(m.costs["run"].peak_mb, 3),
        "sent to blocks, MB: once": lambda m: exact(m.spread["bytes_shelved"] / 2**20, 3),
        "each time, all maps together": lambda m: exact(m.spread["bytes_sent"] / 2**20, 3),
        "back from blocks, MB": lambda m: exact(m.spread["bytes_back"] / 2**20, 3),
        "store, MB": lambda m: exact(m.store_mb, 3),
        "bytes as in processes of this machine": lambda m: {True: "yes", False: "NO", None: "not compared"}[
            m.same_bytes
        ],
    }
    return table(["photos", *(str(m.photos) for m in sizes)], [[name, *map(of, sizes)] for name, of in lines.items()])


MANY = 100_000


def worked_out(small: Measured, large: Measured) -> str:
    """The table for MANY photos, by the straight line through the two largest sizes that were measured."""
    lines = {
        "masks, align, urm: processor hours": lambda m: (
            sum(m.stages[name].cpu_seconds for name in ("masks", "align", "urm")) / 3600
        ),
        "solve: processor hours": lambda m: m.stages["solve"].cpu_seconds / 3600,
        "of these in its own process, one after the other": lambda m: (
            (m.stages["solve"].cpu_seconds - m.spread["cpu_seconds"]) / 3600
        ),
        "memory of its own process, GB": lambda m: m.stages["solve"].peak_mb / 1024,
        "scheduler: processor hours": lambda m: m.costs["scheduler"].cpu_seconds / 3600,
        "scheduler's memory, GB": lambda m: m.costs["scheduler"].peak_mb / 1024,
        "the run's own: processor hours": lambda m: m.costs["run"].cpu_seconds / 3600,
        "the run's memory, GB": lambda m: m.costs["run"].peak_mb / 1024,
        "sent to blocks once, GB": lambda m: m.spread["bytes_shelved"] / 2**30,
        "sent each time, all maps together, GB": lambda m: m.spread["bytes_sent"] / 2**30,
        "back from blocks, GB": lambda m: m.spread["bytes_back"] / 2**30,
        "store, GB": lambda m: m.store_mb / 1024,
        "files in the store, millions": lambda m: m.store_files / 1e6,
    }
    head = [f"{MANY:,} photos", f"from {small.photos} and {large.photos}"]
    return table(
        head, [[name, exact(_at(of(small), of(large), small.photos, large.photos), 2)] for name, of in lines.items()]
    )


def _at(small: float, large: float, few: int, more: int) -> float:
    """
    >>> _at(1.0, 2.0, 100, 200)
    1000.0
    """
    return large + (large - small) / (more - few) * (MANY - more)


if __name__ == "__main__":
    typer.run(main)
