"""The real pipeline on a real cluster: the same bytes as in processes of one machine, with a worker killed while it solves."""

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from benchmarks.scale.scenes import BALLS, FOCAL, HEIGHT, RADIUS, ball_at, centre_of, write_set
from benchmarks.scale.watch import Watch
from factorlib.dataset.read import read_dataset
from factorlib.images.exr import read_exr
from factorlib.runner.project import LIBRARY
from tests.runner.toy import files_of

SMALL = (
    "urm.directions=0 solve.solver=few_lobes solve.lobes=4 solve.insert=4 solve.rounds=1 solve.iterations=3 solve.polish=1 solve.settle=1 solve.sample=200 "
    "solve.specular=on"
)


def test_a_generated_set_is_a_data_set_and_the_same_one_each_time(tmp_path):
    for name in ("one", "two"):
        write_set(tmp_path / name, 3, 7)
    assert files_of(tmp_path / "one") == files_of(tmp_path / "two")
    spec = read_dataset(tmp_path / "one").spec
    assert len(spec.photos) == 3 and len(spec.materials) == 7
    for photo in spec.photos:
        assert len({shown.mesh for shown in photo.objects}) == BALLS
        label = read_label(tmp_path / "one" / photo.masks)
        seen = read_exr(tmp_path / "one" / photo.image)
        radiance = np.stack([seen[c] for c in "RGB"], axis=-1)
        assert set(np.unique(label)) == {0, *(spec.materials.index(shown.mesh) + 1 for shown in photo.objects)}
        assert (radiance[label == 0] == 0).all() and (radiance[label > 0] > 0).all()


def read_label(path):
    from PIL import Image

    return np.asarray(Image.open(path))


@pytest.mark.parametrize("place", range(BALLS))
def test_a_balls_normals_are_unit_and_point_from_its_centre_to_what_the_pixel_sees(place):
    ball = ball_at(place)
    assert np.allclose(np.linalg.norm(ball.normal, axis=1), 1) and ((ball.normal * ball.view).sum(1) > 0).all()
    point = np.array([centre_of(place), 0, 40.0]) + ball.normal
    assert np.allclose(np.cross(point, ball.view), 0, atol=1e-9), "the point is not on the pixel's ray"
    rows = point[:, 1] / point[:, 2] * FOCAL
    assert np.allclose(np.unique(rows.round(6)), np.flatnonzero(ball.inside.any(1)) + 0.5 - HEIGHT / 2)
    assert 0.9 * RADIUS < rows.max() < 1.03 * RADIUS


def test_what_processes_cost_is_seen_by_their_role():
    watch = Watch()
    code = "x = bytearray(64 << 20)\nimport time\nend = time.process_time() + .5\nwhile time.process_time() < end: pass\ntime.sleep(1.2)"
    subprocess.run([sys.executable, "-c", code, "dask_scheduler"], check=True)
    cost = watch.close()["scheduler"]
    assert cost.processes == 1 and 0.4 < cost.cpu_seconds < 3 and 64 < cost.peak_mb < 200


def run(folder, build, *settings):
    command = [sys.executable, "-m", "benchmarks.scale.project", str(folder), str(build), SMALL, *settings]
    return subprocess.run(
        command, cwd=LIBRARY, env={**os.environ, "OMP_NUM_THREADS": "1"}, capture_output=True, text=True, check=False
    )


@pytest.mark.long
def test_masks_to_solve_give_the_same_bytes_with_a_worker_killed_over_the_solve(tmp_path):
    pytest.importorskip("distributed", reason="make setup EXTRAS=dask")
    from tests.runner.clusters import LiveCluster, doing, offspring

    write_set(tmp_path / "few", 4, 8)
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
    assert kept(tmp_path / "cluster") == kept(tmp_path / "processes")
    assert said(done) == said(beside), "what steps warn of"


def kept(build: Path) -> dict[str, bytes]:
    return files_of(build / "store" / "keys") | files_of(build / "store" / "trees")


def said(done: subprocess.CompletedProcess) -> list[str]:
    return sorted(line for line in done.stderr.splitlines() if line.startswith("warning"))
