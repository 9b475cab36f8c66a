"""The real pipeline on a small data set, killed in each of its stages while it writes: the same bytes afterwards."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import yaml

from factorlib.runner import verbs
from factorlib.runner.project import LIBRARY, Project, photo_sets
from tests.faults.battered import end, wait_until
from tests.faults.tries import note
from tests.runner.toy import files_of

pytestmark = [
    pytest.mark.long,
    pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks for processes in /proc"),
]
STAGES = ("masks", "align", "urm", "train", "solve", "export", "render", "evaluate", "report")
EACH = 5
QUICK = [
    "masks.pixels=3000", "urm.most=5000", "urm.directions=0", "solve.solver=few_lobes", "solve.rounds=1",
    "solve.lobes=12", "solve.iterations=2",
    "solve.polish=1", "export.height=32", "export.mitsuba_height=32",
]  # fmt: skip
LEFT_OUT = "study"  # the photo whose poses are searched


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Two photos of data/synthetic, everything made; a copy of the source, which nobody edits meanwhile."""
    root = tmp_path_factory.mktemp("real")
    shutil.copy(LIBRARY / "pipeline.yaml", root)
    for name in ("stages", "factorlib", "data/synthetic"):
        shutil.copytree(LIBRARY / name, root / name, ignore=shutil.ignore_patterns("__pycache__"))
    files = [root / "data" / "synthetic" / name for name in ("dataset.yaml", "truth/truth.yaml")]
    spec, truth = (yaml.safe_load(file.read_text()) for file in files)
    spec["photos"] = [photo for photo in spec["photos"] if photo["name"] != LEFT_OUT]
    for part in truth.values():
        part.pop(LEFT_OUT, None)
    for file, content in zip(files, (spec, truth)):
        file.write_text(yaml.safe_dump(content))
    project = Project(root, photo_sets())
    assert verbs.make(project, verbs.Wish("synthetic", settings=QUICK)) == 0
    return project


def forget(project, stage):
    """The results of a stage, and of what takes them, are deleted; what is above stays."""
    store, below = project.build / "store", STAGES[STAGES.index(stage) :]
    for path in (store / "keys").glob("*.json"):
        entry = json.loads(path.read_bytes())
        if entry["record"]["stage"] in below:
            path.unlink()
            shutil.rmtree(store / "trees" / entry["output"], ignore_errors=True)


@pytest.mark.parametrize("stage", STAGES)
def test_a_stage_that_is_killed_while_it_writes_ends_in_the_same_bytes(whole, stage):
    results = lambda: files_of((whole.build / "synthetic" / stage).resolve())  # noqa: E731
    begun = lambda: any((whole.build / "store" / "tmp").glob(f"run-*/{stage}*/*"))  # noqa: E731
    command = [sys.executable, "-m", "factorlib", stage, "--dataset", "synthetic", *(f"--set={word}" for word in QUICK)]
    environment = {**os.environ, "FACTORLIB_ROOT": str(whole.root), "PYTHONPATH": str(LIBRARY)}
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True, "start_new_session": True}
    wanted, hits = results(), 0
    for number in range(4 * EACH):
        if hits == EACH:
            break
        forget(whole, stage)
        process = subprocess.Popen(command, env=environment, **pipes)
        wait_until(lambda process=process: begun() or process.poll() is not None, seconds=300, every=0.0005)
        time.sleep(0.003 * (number % 3))
        hits += begun()
        os.killpg(process.pid, signal.SIGKILL)
        end(process)
        assert verbs.make(whole, verbs.Wish("synthetic", [stage], QUICK)) == 0
        assert results() == wanted
    note("faults", "SIGKILL, the real pipeline", hits)
    note("hits", "mid-write", hits, stages={f"{stage} (real)": hits})
    assert hits == EACH
    assert verbs.make(whole, verbs.Wish("synthetic", settings=QUICK)) == 0
