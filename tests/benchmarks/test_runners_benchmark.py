"""The benchmark beside DVC and Snakemake: that all are given the same work, and how its numbers are put together."""

import json
import os
import subprocess
import sys
from xml.etree import ElementTree

from benchmarks.runners.__main__ import Timing, as_table, measured
from benchmarks.runners.picture import picture
from benchmarks.runners.projects import WORK, inputs_of, make_outputs, write_dvc, write_factorlib, write_photos, write_snakemake
from factorlib.runner.project import LIBRARY


def project(folder, write, outputs):
    """A project of two photos."""
    folder.mkdir()
    (folder / "work.py").write_text(WORK)
    write_photos(folder, 2)
    if outputs:
        make_outputs(folder, 2)
    write(folder, 2)
    return folder


def test_our_run_makes_the_bytes_that_the_others_are_given(tmp_path):
    ours, theirs = project(tmp_path / "ours", write_factorlib, False), project(tmp_path / "theirs", write_snakemake, True)
    environment = {**os.environ, "FACTORLIB_ROOT": str(ours), "PYTHONPATH": str(LIBRARY)}
    done = subprocess.run([sys.executable, "-m", "factorlib", "all", "-d", "set"], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    for step in ("develop", "pose", "sample"):
        for name in ("photo_00000", "photo_00001"):
            made = (ours / "build" / "set" / step / f"{name}.bin").read_bytes()
            assert made == (theirs / "out" / step / f"{name}.bin").read_bytes()
    assert (ours / "build" / "set" / "total" / "total.bin").read_bytes() == (theirs / "out" / "total.bin").read_bytes()


def test_a_command_written_for_dvc_makes_what_its_lock_says(tmp_path):
    folder = project(tmp_path / "dvc", write_dvc, True)
    stages = json.loads((folder / "dvc.lock").read_text())["stages"]
    assert len(stages) == 2 * 3 + 1
    for name in ("pose-photo_00001", "total"):
        out = folder / stages[name]["outs"][0]["path"]
        before = out.read_bytes()
        out.unlink()
        subprocess.run(stages[name]["cmd"].replace("python", sys.executable, 1), shell=True, cwd=folder, check=True)
        assert out.read_bytes() == before
    deps = [entry["path"] for entry in stages["sample-photo_00000"]["deps"]]
    assert deps == sorted(["work.py", *inputs_of("sample", "photo_00000")])


def test_programs_that_are_not_there_are_left_out(tmp_path, capsys):
    (timing, *others) = measured(tmp_path / "2", 2, ["factorlib"], tmp_path / "no tools", 1)
    assert timing.program == "factorlib" and [one.verb for one in (timing, *others)] == ["nothing to do", "plan", "status"]
    assert "| 7 steps (2 photos), plan |" in as_table([timing, *others])


def test_a_ratio_is_that_of_the_rounds():
    ours, theirs = Timing(6, "plan", "factorlib", [0.1, 0.2, 1.0], [0.1] * 3), Timing(6, "plan", "dvc", [0.5, 1.0, 5.0], [0.4] * 3)
    assert "| 19 steps (6 photos), plan | .2 s (.1) | 1 s (.4) | 5.0× |  |  |" in as_table([ours, theirs])
    ElementTree.fromstring(picture([ours, theirs]))
