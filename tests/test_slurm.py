"""The worked example for Slurm, docs/slurm.py: the job script that it generates, shown in docs/distributed.md, starts a worker that serves a run."""

import os
import runpy
import signal
import subprocess
import sys

import pytest

pytest.importorskip("dask_jobqueue", reason="make setup EXTRAS=dask")

from factorlib.runner import verbs
from factorlib.runner.project import LIBRARY
from tests.runner import toy
from tests.runner.toy import files_of

SLURM = LIBRARY / "docs" / "slurm.py"


@pytest.fixture(scope="module")
def example():
    return runpy.run_path(str(SLURM))


@pytest.fixture
def cluster(example, tmp_path):
    options = {"dashboard_address": ":0", "host": "127.0.0.1"}
    with example["slurm_cluster"](scheduler_options=options, log_directory=str(tmp_path)) as result:
        yield result


@pytest.mark.long
def test_the_job_script_run_as_slurm_would_starts_a_worker_that_serves_a_run(cluster, tmp_path):
    """Every line of it but the interpreter's path, which is that of the tests."""
    script = cluster.job_script().replace(f"{LIBRARY}/.venv/bin/python", sys.executable)
    project = toy.make_project(tmp_path / "root")
    other = toy.copy(project, tmp_path / "beside")
    job = subprocess.Popen(
        ["bash", "-c", script], env={**os.environ, "PYTHONPATH": str(LIBRARY)}, cwd=tmp_path, start_new_session=True
    )
    try:
        assert verbs.make(project, verbs.Request("set", settings=[f"executor={cluster.scheduler_address}"])) == 0
    finally:
        os.killpg(job.pid, signal.SIGTERM)
        job.wait(60)
    assert verbs.make(other, verbs.Request("set")) == 0
    assert files_of(project.build / "store" / "trees") == files_of(other.build / "store" / "trees")
