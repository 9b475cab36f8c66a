"""A run with nothing to do, a plan after one photo has changed, and a status: factorlib beside DVC and Snakemake.

`python -m benchmarks.runners` (`make bench-runners`) writes one graph for all three (`benchmarks.runners.projects`) below
build/bench/runners, lets each take all of it as made, and then times cold processes: every command once in each round, the
three programs alternating.  `--tools`: the folder of an environment with dvc and snakemake,

    python3 -m venv build/bench/runners/tools && build/bench/runners/tools/bin/pip install dvc snakemake

without which their columns stay empty.  `--docs` also refreshes docs/runner.md and its figure.
"""

from __future__ import annotations

import json
import os
import resource
import shutil
import subprocess
import sys
import time
from pathlib import Path
from statistics import median
from typing import Annotated

import msgspec
import typer

from benchmarks.markdown import ROOT, refresh, table
from benchmarks.rounded import exact
from benchmarks.runners.picture import picture
from benchmarks.runners.projects import WORK, WRITERS, make_outputs, names, write_photos
from factorlib.wholefile import write_text

OURS = "factorlib"
VERBS = ("nothing to do", "plan", "status")
HERE = [sys.executable, "-m", "factorlib"]
COMMANDS = {
    OURS: {"make": [*HERE, "all", "-d", "set"], "nothing to do": [*HERE, "all", "-d", "set"], "plan": [*HERE, "plan", "-d", "set"],
           "status": [*HERE, "status", "-d", "set"]},
    "dvc": {"make": ["dvc", "status"], "nothing to do": ["dvc", "repro"], "plan": ["dvc", "repro", "--dry"], "status": ["dvc", "status"]},
    "snakemake": {"make": ["snakemake", "-c1", "--touch", "-q", "all"], "nothing to do": ["snakemake", "-c1"], "plan": ["snakemake", "-n"],
                  "status": ["snakemake", "--summary"]},
}  # fmt: skip
NOTHING = {OURS: "nothing to do", "dvc": "up to date", "snakemake": "Nothing to be done"}  # what each says where all is current


class Timing(msgspec.Struct, frozen=True):
    """One command of one program: wall and processor seconds of every round."""

    photos: int
    verb: str
    program: str
    wall: list[float]
    processor: list[float]


def main(
    photos: Annotated[str, typer.Option(help="photos of each graph")] = "6,1000",
    rounds: Annotated[int, typer.Option(min=1, help="of all commands")] = 7,
    tools: Annotated[Path, typer.Option(help="environment with dvc and snakemake")] = ROOT / "build" / "bench" / "runners" / "tools",
    docs: Annotated[bool, typer.Option(help="also refresh docs/runner.md")] = False,
    out: Annotated[Path, typer.Option(help="folder to work in")] = ROOT / "build" / "bench" / "runners",
) -> None:
    """Time all programs that are there."""
    programs = [program for program in WRITERS if program == OURS or (tools / "bin" / program).is_file()]
    for program in WRITERS.keys() - set(programs):
        print(f"{program} is skipped: there is no {tools / 'bin' / program}")
    timings = [timing for count in map(int, photos.split(",")) for timing in measured(out / str(count), count, programs, tools, rounds)]
    write_text(out / "timings.json", json.dumps(msgspec.to_builtins(timings), indent=1) + "\n")
    print(as_table(timings))
    write_text(out / "runners.svg", picture(timings))
    if docs:
        refresh(ROOT / "docs" / "runner.md", {"runners": as_table(timings)})
        write_text(ROOT / "docs" / "runner" / "runners.svg", picture(timings))


def measured(folder: Path, photos: int, programs: list[str], tools: Path, rounds: int) -> list[Timing]:
    """The timings of one graph; its projects are made where they are not there yet."""
    runs = {program: Program(program, folder / program, photos, tools) for program in programs}
    for run in runs.values():
        run.prepare()
    found = []
    for verb in VERBS:
        for run in runs.values():
            run.change_a_photo(verb == "plan")
            run.call("plan" if verb == "plan" else "nothing to do" if verb == "nothing to do" else verb)  # hashes are in its caches now
        taken = {program: [] for program in programs}
        for number in range(rounds):
            order = programs[number % len(programs) :] + programs[: number % len(programs)]
            for program in order:
                taken[program].append(runs[program].timed(verb))
        found += [Timing(photos, verb, program, [t for t, _ in of], [c for _, c in of]) for program, of in taken.items()]
        print(f"{photos} photos, {verb}: " + ", ".join(f"{program} {median(t for t, _ in of):.2f} s" for program, of in taken.items()), flush=True)
    for run in runs.values():
        run.change_a_photo(False)
    return found


class Program:
    """One of the three, with its project."""

    def __init__(self, name: str, folder: Path, photos: int, tools: Path):
        self.name, self.folder, self.photos = name, folder, photos
        self.environment = {**os.environ, "PATH": f"{tools / 'bin'}:{os.environ['PATH']}", "FACTORLIB_ROOT": str(folder), "PYTHONPATH": str(ROOT)}
        self.environment |= {"DVC_NO_ANALYTICS": "1"}
        for name_ in ("DATASET", "SET", "FORCE", "RECIPE", "PYTHONDONTWRITEBYTECODE"):
            self.environment.pop(name_, None)

    def prepare(self) -> None:
        """The project, with everything made, so that the program says that there is nothing to do."""
        if (self.folder / "ready").exists():
            return
        shutil.rmtree(self.folder, ignore_errors=True)
        self.folder.mkdir(parents=True)
        write_text(self.folder / "work.py", WORK)
        write_photos(self.folder, self.photos)
        if self.name != OURS:
            make_outputs(self.folder, self.photos)
        WRITERS[self.name](self.folder, self.photos)
        if self.name == "dvc":
            self._run(["dvc", "init", "-q", "--no-scm"])
        self._run(COMMANDS[self.name]["make"])
        said = self._run(COMMANDS[self.name]["nothing to do"])
        if NOTHING[self.name] not in said:
            raise RuntimeError(f"{self.name} does not take everything as made: {said[-2000:]}")
        write_text(self.folder / "ready", "")

    def change_a_photo(self, changed: bool) -> None:
        """The first photo's bytes are those of the second, or its own; only where that is not so already."""
        photos = self.folder / "data" / "set" / "photos" if self.name == OURS else self.folder / "photos"
        first, second = (photos / f"{name}.png" for name in names(2))
        kept = self.folder / "first.png"
        if changed and not kept.exists():
            os.rename(first, kept)
            shutil.copyfile(second, first)
        elif not changed and kept.exists():
            os.replace(kept, first)  # with the times that it had

    def call(self, verb: str) -> None:
        """Run a command once, untimed."""
        self._run(COMMANDS[self.name][verb])

    def timed(self, verb: str) -> tuple[float, float]:
        """Wall and processor seconds of a command, its children included."""
        before, started = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
        self._run(COMMANDS[self.name][verb])
        wall, after = time.perf_counter() - started, resource.getrusage(resource.RUSAGE_CHILDREN)
        return wall, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime

    def _run(self, command: list[str]) -> str:
        done = subprocess.run(command, cwd=self.folder, env=self.environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False)
        if done.returncode:
            raise RuntimeError(f"{' '.join(command)} in {self.folder}: {done.stdout[-2000:]}")
        return done.stdout


def as_table(timings: list[Timing]) -> str:
    """A row for each graph and verb: median seconds of each program, and how many times ours the others take."""
    rows = []
    for photos, verb in dict.fromkeys((one.photos, one.verb) for one in timings):
        of = {one.program: one for one in timings if (one.photos, one.verb) == (photos, verb)}
        ours = of[OURS]
        row = [f"{3 * photos + 1} steps ({photos} photos), {verb}", _seconds(ours)]
        for program in ("dvc", "snakemake"):
            row += [_seconds(of[program]), f"{ratio(of[program], ours):.1f}×"] if program in of else ["", ""]
        rows.append(row)
    return table(["", "factorlib", "DVC", "", "Snakemake", ""], rows)


def _seconds(one: Timing) -> str:
    """Wall time, and in brackets that of processors."""
    return f"{exact(median(one.wall))} s ({exact(median(one.processor))})"


def ratio(other: Timing, ours: Timing) -> float:
    """The median of the ratios of wall times, round by round: what disturbs a round disturbs both."""
    return median(a / b for a, b in zip(other.wall, ours.wall, strict=True))


if __name__ == "__main__":
    typer.run(main)
