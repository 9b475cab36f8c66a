"""The whole pipeline on data/synthetic, by the runner as a user runs it.

Its numbers are compared with those stored of the last run and what seeds change of them (`studies.measured.reference`): of
a small run, stage by stage, in `make test`; of the data set as it is in `make test-long`, also with the bounds of
`reference.BOUNDS`, which are how good it must be at worst.  The long run uses the project's own build/, so that what is
current there is not made again: keys are by content.
"""

import os
import subprocess
import sys

import pytest

from factorlib.jsonfile import read_json
from factorlib.runner.project import LIBRARY
from studies.measured.reference import BOUNDS, complaint, differences, metric_numbers, read_stored, run_small


def test_every_number_of_a_small_run_is_as_stored_stage_by_stage(tmp_path):
    moved = differences(run_small(tmp_path), read_stored("small"))
    assert not moved, complaint(moved)


@pytest.mark.long
def test_every_number_is_as_stored_and_every_bound_holds():
    command = [sys.executable, "-m", "factorlib", "all", "--dataset", "synthetic"]
    environment = {k: v for k, v in os.environ.items() if k not in ("DATASET", "FACTORLIB_ROOT")}
    process = subprocess.run(command, cwd=LIBRARY, env=environment, capture_output=True, text=True)
    assert process.returncode == 0, f"{' '.join(command)}\n{process.stdout}\n{process.stderr}"
    metrics = read_json(LIBRARY / "build" / "synthetic" / "evaluate" / "metrics.json")
    moved = differences(metric_numbers(metrics), read_stored())
    assert not moved, complaint(moved)
    for path, (lowest, highest, meaning) in BOUNDS.items():
        assert lowest <= metric_numbers(metrics)[path] <= highest, f"{meaning} ({path})"
    page = (LIBRARY / "build" / "synthetic" / "report" / "index.html").read_text(encoding="utf-8")
    assert "Re-synthesis" in page and "Materials against the truth" in page
