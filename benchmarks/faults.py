"""The tables of docs/reliability.md, of what the tests of faults tried: `python -m benchmarks.faults [--docs] [faults|reruns|fuzz …]`.

Runs those tests, the short and the long ones, and counts what they say they tried and what was lost by it.  A table is made
only where every test has passed.  `--log FILE` makes the tables of a log that `FAULTS_LOG=FILE make test-long` has left.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path
from typing import Annotated

import msgspec
import typer

from benchmarks.markdown import ROOT, refresh, table

DOCS = ROOT / "docs" / "reliability.md"
TESTS = {
    "faults": ["tests/faults/test_nothing_lost.py", "tests/faults/test_no_room.py", "tests/faults/test_real_kills.py"],
    "reruns": ["tests/faults/test_reruns.py"],
    "fuzz": ["tests/faults/test_fuzz.py"],
}


class Tried(msgspec.Struct, frozen=True):
    """A line of the log: what a test tried, how often, and what was lost or came out.

    stages: by stage, how often it was writing when it was struck;  accepted, refused, other: of spoiled files
    """

    table: str
    name: str
    tries: int
    lost: int = 0
    stages: dict[str, int] | None = None
    accepted: int = 0
    refused: int = 0
    other: int = 0


def tried(log: Path) -> list[Tried]:
    """Every line of a log."""
    return [msgspec.json.decode(line, type=Tried) for line in log.read_bytes().splitlines()]


def summed(found: list[Tried], of: str, *fields: str) -> dict[str, Counter]:
    """By name, in the order of the tests, the sums of fields."""
    sums: dict[str, Counter] = {}
    for one in (one for one in found if one.table == of):
        counter = sums.setdefault(one.name, Counter())
        counter.update({field: getattr(one, field) for field in fields})
    return sums


def tables(found: list[Tried]) -> dict[str, str]:
    """Those of which there is any line."""
    faults = [
        [name, f"{s['tries']:,}", f"{s['lost']:,}"] for name, s in summed(found, "faults", "tries", "lost").items()
    ]
    reruns = [[name, f"{s['tries']:,}", "0"] for name, s in summed(found, "reruns", "tries").items()]
    spoiled = summed(found, "fuzz", "tries", "accepted", "refused", "other")
    fuzz = [
        [name, *(f"{s[field]:,}" for field in ("tries", "accepted", "refused", "other"))] for name, s in spoiled.items()
    ]
    total = [f"{sum(s[field] for s in spoiled.values()):,}" for field in ("tries", "accepted", "refused", "other")]
    struck = sum((Counter(one.stages) for one in found if one.table == "hits" and one.stages), Counter())
    made = {
        "faults": table(["fault", "tries", "lost"], faults) if faults else "",
        "hits": table(["stage", "killed while it was writing"], [[name, str(count)] for name, count in struck.items()])
        if struck
        else "",
        "reruns": table(["change", "changes", "wrong reruns"], reruns) if reruns else "",
        "fuzz": table(["file", "tries", "read", "refused", "other"], [*fuzz, ["all", *total]]) if fuzz else "",
    }
    return {name: text for name, text in made.items() if text}


def measured(parts: list[str], log: Path) -> bool:
    """Run the tests of the parts, which add to the log; whether all have passed."""
    files = [file for part in parts for file in TESTS[part]]
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-m", "long or not long", *files]
    environment = {**os.environ, "FAULTS_LOG": str(log), "OMP_NUM_THREADS": "1", "PYTHONDONTWRITEBYTECODE": "1"}
    return subprocess.run(command, cwd=ROOT, env=environment, check=False).returncode == 0


def main(
    parts: Annotated[list[str] | None, typer.Argument(help="faults, reruns, fuzz; all without it")] = None,
    docs: Annotated[bool, typer.Option("--docs", help="write the tables into docs/reliability.md")] = False,
    log: Annotated[Path | None, typer.Option(help="a log to make the tables of, without running anything")] = None,
) -> None:
    """Print the tables."""
    wanted = parts or list(TESTS)
    if unknown := [part for part in wanted if part not in TESTS]:
        raise SystemExit(f"there is no {unknown[0]!r}: name {', '.join(TESTS)}")
    with tempfile.TemporaryDirectory() as folder:
        file = log or Path(folder) / "log.jsonl"
        if log is None and not measured(wanted, file):
            raise SystemExit("a test has failed: no table")
        found = tables(tried(file))
    print("\n\n".join(found.values()))
    if docs:
        fuzz = {"fuzz": found.pop("fuzz")} if "fuzz" in found else {}
        refresh(DOCS, found)
        refresh(DOCS, fuzz)  # of the sources of what reads the spoiled files


if __name__ == "__main__":
    typer.run(main)
