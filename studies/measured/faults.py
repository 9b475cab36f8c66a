"""What the tests of faults tried and what was lost by it: `make results ONLY=faults`, for docs/reliability.md.

Runs the tests in tests/faults that count, the short and the long ones; FUZZ_SECONDS says how long each of three kinds of fuzz goes on.  A
table is made only where every test has passed.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path

import msgspec

from factorlib.errors import InputError
from studies.measured.tools import ROOT, Tables

TESTS = ("test_nothing_lost", "test_reruns", "test_fuzz")
COLUMNS = {  # table in the log -> its title, and the head of the first column with those of the numbers, by field
    "faults": ("Faults", {"": "fault", "tries": "tries", "lost": "lost"}),
    "reruns": ("Reruns", {"": "change", "tries": "changes", "lost": "wrong reruns"}),
    "fuzz": ("Fuzz", {"": "file", "tries": "tries", "accepted": "read", "refused": "refused", "other": "other"}),
}


def tables_of(lines: list[dict]) -> Tables:
    """Sums over the lines of one table and name: {"table", "name", "tries", "lost", …}, `stages`: by stage, how often it was struck."""
    tables: Tables = {}
    for key, (title, columns) in COLUMNS.items():
        fields, sums = list(columns)[1:], {}
        for one in (one for one in lines if one["table"] == key):
            sums.setdefault(one["name"], Counter()).update({field: one.get(field, 0) for field in fields})
        if key == "fuzz" and sums:
            sums["all"] = sum(sums.values(), Counter())
        if sums:
            counts = [[name, *(f"{of[field]:,}" for field in fields)] for name, of in sums.items()]
            tables[title] = [list(columns.values()), *counts]
    if struck := sum((Counter(one["stages"]) for one in lines if one["table"] == "hits"), Counter()):
        tables["Hits"] = [["stage", "killed while it was writing"], *([k, str(n)] for k, n in struck.items())]
    return tables


def rows() -> Tables:
    """Run the tests, and count.  InputError where one has failed."""
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "log.jsonl"
        files = [f"tests/faults/{name}.py" for name in TESTS]
        command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-m", "long or not long", *files]
        environment = {**os.environ, "FAULTS_LOG": str(log), "PYTHONDONTWRITEBYTECODE": "1"}
        if subprocess.run(command, cwd=ROOT, env=environment, check=False).returncode:
            raise InputError("a test has failed: see above", key="faults", cure="mend it, and run this again")
        return tables_of([msgspec.json.decode(line) for line in log.read_bytes().splitlines()])
