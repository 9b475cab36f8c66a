"""The whole pipeline on data/synthetic, by the runner as a user runs it, against the numbers stored of the last run and what seeds
change of them (`benchmarks.reference`), and against the bounds of `evaluate.table`, which are how good it must be at worst.

The run uses the project's own build/, so that what is current there is not made again: keys are by content.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.reference import complaint, differences, read_stored
from factorlib.evaluate.table import SYNTHETIC, Row, rows_of, table_text
from factorlib.jsonfile import read_json

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def rows() -> list[Row]:
    command = [sys.executable, "-m", "factorlib", "all", "--dataset", "synthetic"]
    environment = {k: v for k, v in os.environ.items() if k not in ("DATASET", "FACTORLIB_ROOT")}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, f"{' '.join(command)}\n{done.stdout}\n{done.stderr}"
    return rows_of(read_json(ROOT / "build" / "synthetic" / "evaluate" / "metrics.json"), SYNTHETIC)


def test_every_number_is_as_stored(rows):
    found = differences(read_json(ROOT / "build" / "synthetic" / "evaluate" / "metrics.json"), read_stored())
    assert not found, complaint(found)


def test_every_bound_holds(rows):
    text = table_text(rows)
    print(text)
    assert all(row.ok for row in rows), f"data/synthetic misses its bounds:\n{text}"


def test_the_report_is_there(rows):
    page = (ROOT / "build" / "synthetic" / "report" / "index.html").read_text(encoding="utf-8")
    assert "Re-synthesis" in page and "Materials against the truth" in page
