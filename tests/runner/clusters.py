"""A real Dask cluster of a few processes over TCP, for tests: a scheduler, and workers that can be killed."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from factorlib.runner.project import LIBRARY


class LiveCluster(contextlib.AbstractContextManager):
    """A scheduler in a process of its own, and its workers."""

    def __init__(self, workers: int, folder: Path, environment: dict[str, str] | None = None):
        self.folder, self.environment = folder, environment or {}
        self.processes: list[subprocess.Popen] = []
        options = ["--host", "127.0.0.1", "--port", "0", "--no-dashboard"]
        self.start("distributed.cli.dask_scheduler", *options, says="Scheduler at")
        self.address = re.search(r"tcp://\S+", self.log(0))[0]
        for _ in range(workers):
            self.add_worker()

    def add_worker(self) -> subprocess.Popen:
        """One more, of one core; returns when the scheduler knows it."""
        options = f"--nthreads 1 --host 127.0.0.1 --local-directory {tempfile.gettempdir()}".split()
        return self.start("distributed.cli.dask_worker", self.address, *options, says="Registered to")

    def start(self, *words: str, says: str) -> subprocess.Popen:
        """A process `python -m <words>` that has written `says`, a colon and a word into its log."""
        more = {"PYTHONPATH": str(LIBRARY), "DASK_DISTRIBUTED__COMM__TIMEOUTS__CONNECT": "60s", **self.environment}
        number, end = len(self.processes), time.monotonic() + 120
        with open(self.folder / f"{number}.log", "wb") as log:
            outer = {"env": {**os.environ, **more}, "stdout": log, "stderr": log, "cwd": self.folder}
            self.processes.append(subprocess.Popen([sys.executable, "-m", *words], start_new_session=True, **outer))
        while not re.search(rf"{says}:\s+\S", self.log(number)):
            assert time.monotonic() < end, self.log(number)
            time.sleep(0.05)
        return self.processes[-1]

    def log(self, number: int) -> str:
        return (self.folder / f"{number}.log").read_text()

    @property
    def settings(self) -> list[str]:
        """The words that make a run use it."""
        return [f"executor={self.address}"]

    def kill_workers(self) -> None:
        """SIGKILL to all but the scheduler."""
        while len(self.processes) > 1:
            self._kill(self.processes.pop())

    def close(self) -> None:
        """SIGKILL to all."""
        self.kill_workers()
        self._kill(self.processes[0])

    def _kill(self, process: subprocess.Popen) -> None:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()

    def __exit__(self, *exception: object) -> None:
        self.close()


def offspring(pid: int) -> list[int]:
    """All processes below a process, parents first."""
    below: dict[int, list[int]] = {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            below.setdefault(int(stat.read_text().rpartition(")")[2].split()[1]), []).append(int(stat.parent.name))
    pids = [pid]
    for one in pids:
        pids += below.get(one, [])
    return pids[1:]


def doing(pid: int, word: str) -> bool:
    """Whether a process has that word on its command line."""
    with contextlib.suppress(OSError):
        return word.encode() in Path(f"/proc/{pid}/cmdline").read_bytes()
    return False
