"""The real pipeline on a real cluster: the same bytes as in processes of one machine, with a worker killed while it solves."""

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from factorlib.runner.project import LIBRARY
from studies.scenes.balls import write_set
from tests.runner.toy import files_of

SMALL = (
    "urm.directions=0 solve.solver=few_lobes solve.lobes=4 solve.insert=4 solve.rounds=1 solve.iterations=3 solve.polish=1 solve.settle=1 solve.sample=200 "
    "solve.specular=on"
)


def run(folder, build, *settings):
    command = [sys.executable, "-m", "studies.measured.scale", str(folder), str(build), SMALL, *settings]
    return subprocess.run(
        command, cwd=LIBRARY, env={**os.environ, "OMP_NUM_THREADS": "1"}, capture_output=True, text=True, check=False
    )


@pytest.mark.long
def test_masks_to_solve_give_the_same_bytes_with_a_worker_killed_over_the_solve(tmp_path):
    pytest.importorskip("distributed", reason="make setup EXTRAS=dask")
    from tests.runner.clusters import LiveCluster, doing, offspring

    for name in ("few", "again"):
        write_set(tmp_path / name, 4, 8)
    assert files_of(tmp_path / "few") == files_of(tmp_path / "again"), "the set is the same one each time"
    live, killed = LiveCluster(2, tmp_path), []

    def kill_one():
        """Once blocks of the solve are on their way: the worker that has not the step itself."""
        while not list((tmp_path / "cluster/store/tmp").glob("run-*/solve.*.shelf/*")):
            time.sleep(0.05)
        pids = [pid for process in live.processes for pid in offspring(process.pid) if doing(pid, "spawn_main")]
        killed.append(min(pids, key=lambda pid: sum(doing(below, "runner.child") for below in offspring(pid))))
        os.kill(killed[0], signal.SIGKILL)

    thread = threading.Thread(target=kill_one, daemon=True)
    thread.start()
    try:
        done = run(tmp_path / "few", tmp_path / "cluster", *live.settings)
    finally:
        live.close()
    assert done.returncode == 0 and killed, done.stderr
    beside = run(tmp_path / "few", tmp_path / "processes")
    assert beside.returncode == 0, beside.stderr
    assert stored(tmp_path / "cluster") == stored(tmp_path / "processes")
    assert warnings_of(done) == warnings_of(beside), "what steps warn of"


def stored(build: Path) -> dict[str, bytes]:
    return files_of(build / "store" / "keys") | files_of(build / "store" / "trees")


def warnings_of(done: subprocess.CompletedProcess) -> list[str]:
    return sorted(line for line in done.stderr.splitlines() if line.startswith("warning"))
