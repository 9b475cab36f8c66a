"""A run on a Slurm cluster: `.venv/bin/python docs/slurm.py DATASET [SET words …]`, from the checkout, on a login node.

Slurm starts the workers as its jobs (dask-jobqueue); the scheduler and the run live in this process, and so as long as
it.  The checkout, its .venv, its build/ and the data set must lie on a file system that all machines mount at the same
path.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from dask_jobqueue import SLURMCluster

CHECKOUT = Path(__file__).resolve().parent.parent
JOBS, CORES, MEMORY, HOURS = 4, 16, "64GB", 8  # Slurm jobs; of each: cores, memory, time
PARTITION, ACCOUNT = "compute", "my-project"


def slurm_cluster(**more: object) -> SLURMCluster:
    """A scheduler here, and the job script of its workers; no job is asked for yet."""
    return SLURMCluster(
        queue=PARTITION,
        account=ACCOUNT,
        cores=CORES,
        processes=1,  # one worker a job: it starts a process for each step by itself
        memory=MEMORY,
        walltime=f"{HOURS:02d}:00:00",
        python=str(CHECKOUT / ".venv" / "bin" / "python"),
        job_script_prologue=[f"cd {CHECKOUT}"],
        worker_extra_args=["--memory-limit", "0"],  # Slurm limits the memory of a job
        **more,
    )


def main() -> int:
    """Ask for the jobs, run, and give them back."""
    if not sys.argv[1:]:
        sys.exit("give a data set, and settings after it: docs/slurm.py eames solve.cells=800")
    dataset, *settings = sys.argv[1:]
    with slurm_cluster() as cluster:
        cluster.scale(jobs=JOBS)
        words = " ".join([f"executor={cluster.scheduler_address}", *settings])
        return subprocess.call(["make", "all", f"DATASET={dataset}", f"SET={words}"], cwd=CHECKOUT)


if __name__ == "__main__":
    sys.exit(main())
