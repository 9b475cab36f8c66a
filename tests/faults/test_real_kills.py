"""The real pipeline, on the smallest data set there is, killed in each of its stages while it writes: the same bytes afterwards."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import yaml
from faults.battered import end, files_of, wait_until
from faults.tries import note

from factorlib.runner import verbs
from factorlib.runner.project import LIBRARY, Project, photo_sets
from factorlib.runner.store import Store

pytestmark = [
    pytest.mark.long,
    pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks for processes in /proc"),
]
STAGES = ("masks", "align", "urm", "train", "solve", "export", "render", "evaluate", "report")
EACH = 5
QUICK = [
    "masks.pixels=3000",
    "urm.most=5000",
    "urm.directions=0",
    "solve.rounds=1",
    "solve.lobes=12",
    "solve.iterations=2",
    "solve.polish=1",
]
QUICK += ["solve.solver=few_lobes", "export.height=32", "export.mitsuba_height=32"]
LEFT_OUT = "study"  # the photo whose poses are searched


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The pipeline over two photos of data/synthetic, everything made; a copy of the source, which nobody edits meanwhile."""
    root = tmp_path_factory.mktemp("real")
    shutil.copy(LIBRARY / "pipeline.yaml", root)
    for name in ("stages", "factorlib", "data/synthetic"):
        shutil.copytree(LIBRARY / name, root / name, ignore=shutil.ignore_patterns("__pycache__"))
    leave_out(root / "data" / "synthetic")
    project = Project(root, photo_sets())
    assert verbs.make(project, verbs.Wish("synthetic", settings=QUICK)) == 0
    return project


def leave_out(folder):
    spec, truth = (yaml.safe_load((folder / name).read_text()) for name in ("dataset.yaml", "truth/truth.yaml"))
    spec["photos"] = [photo for photo in spec["photos"] if photo["name"] != LEFT_OUT]
    for part in truth.values():
        part.pop(LEFT_OUT, None)
    for name, content in (("dataset.yaml", spec), ("truth/truth.yaml", truth)):
        (folder / name).write_text(yaml.safe_dump(content))


def without(project, stage):
    """The results of a stage, and of what takes them, are forgotten; what is above stays."""
    store, below = Store(project.build / "store"), STAGES[STAGES.index(stage) :]
    for path in store.keys.glob("*.json"):
        entry = store.entry(path.stem)
        if entry and entry.record["stage"] in below:
            path.unlink()
            shutil.rmtree(store.tree(entry.output), ignore_errors=True)


def shown(project, stage):
    return files_of((project.build / "synthetic" / stage).resolve())


def begun(project, stage):
    """Whether a step of the stage has a file in its temporary folder."""
    return any((project.build / "store" / "tmp").glob(f"run-*/{stage}*/*"))


@pytest.mark.parametrize("stage", STAGES)
def test_a_stage_that_is_killed_while_it_writes_ends_in_the_same_bytes(whole, stage):
    wanted, hits = shown(whole, stage), 0
    for number in range(4 * EACH):
        if hits == EACH:
            break
        without(whole, stage)
        words = [
            sys.executable,
            "-m",
            "factorlib",
            stage,
            "--dataset",
            "synthetic",
            *(f"--set={word}" for word in QUICK),
        ]
        environment = {**os.environ, "FACTORLIB_ROOT": str(whole.root), "PYTHONPATH": str(LIBRARY)}
        process = subprocess.Popen(
            words, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True
        )
        wait_until(lambda process=process: begun(whole, stage) or process.poll() is not None, seconds=300, every=0.0005)
        time.sleep(0.003 * (number % 3))
        hit = begun(whole, stage)
        os.killpg(process.pid, signal.SIGKILL)
        end(process)
        hits += hit
        assert verbs.make(whole, verbs.Wish("synthetic", [stage], QUICK)) == 0
        assert shown(whole, stage) == wanted
    note("faults", "SIGKILL, the real pipeline", hits)
    note("hits", "mid-write", hits, stages={f"{stage} (real)": hits})
    assert hits == EACH
    assert verbs.make(whole, verbs.Wish("synthetic", settings=QUICK)) == 0
