"""The whole pipeline on data/synthetic, by the runner as a user runs it.

`make test` runs it at a small size.  `make test-long` runs it as it is, against the numbers stored of the last run and
what seeds change of them (`benchmarks.reference`), and against the bounds of `evaluate.table`, which are how good it must
be at worst; that run uses the project's own build/, so that what is current there is not made again: keys are by content.
"""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from benchmarks.reference import complaint, differences, read_stored
from factorlib.evaluate.table import SYNTHETIC, rows_of, table_text
from factorlib.jsonfile import read_json
from factorlib.runner import verbs
from factorlib.runner.project import LIBRARY, Project, photo_sets

SMALL = [
    "masks.pixels=3000", "urm.most=5000", "urm.directions=0", "solve.cells=60", "solve.splittings=0",
    "solve.observations=600", "solve.tone=off",
    "export.height=32", "export.mitsuba_height=32",
]  # fmt: skip


def report_of(build) -> str:
    return (build / "synthetic" / "report" / "index.html").read_text(encoding="utf-8")


def test_a_small_run_goes_from_photographs_to_a_report_with_every_number(tmp_path):
    for name in ("pipeline.yaml", "stages", "factorlib", "data"):
        (tmp_path / name).symlink_to(LIBRARY / name)
    project = Project(tmp_path, photo_sets())
    assert verbs.make(project, verbs.Wish("synthetic", settings=SMALL)) == 0
    metrics = read_json(project.build / "synthetic" / "evaluate" / "metrics.json")
    assert all(row.value is not None for row in rows_of(metrics, SYNTHETIC))
    assert "Re-synthesis" in report_of(project.build)


@pytest.mark.long
def test_every_number_is_as_stored_and_every_bound_holds():
    command = [sys.executable, "-m", "factorlib", "all", "--dataset", "synthetic"]
    environment = {k: v for k, v in os.environ.items() if k not in ("DATASET", "FACTORLIB_ROOT")}
    done = subprocess.run(command, cwd=LIBRARY, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, f"{' '.join(command)}\n{done.stdout}\n{done.stderr}"
    metrics = read_json(LIBRARY / "build" / "synthetic" / "evaluate" / "metrics.json")
    moved, rows = differences(metrics, read_stored()), rows_of(metrics, SYNTHETIC)
    assert not moved, complaint(moved)
    print(text := table_text(rows))
    assert all(row.ok for row in rows), f"data/synthetic misses its bounds:\n{text}"
    page = report_of(LIBRARY / "build")
    assert "Re-synthesis" in page and "Materials against the truth" in page
