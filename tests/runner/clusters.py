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


class LiveCluster:
    """A scheduler in a process of its own, and its workers, each started by `python -m factorlib worker`."""

    def __init__(self, workers: int, folder: Path, *options: str):
        self.folder = folder
        self.processes: list[subprocess.Popen] = []
        scheduler = ("distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard")
        self.address = self._said(self._start("scheduler", *scheduler), r"Scheduler at:\s+(tcp://\S+)")
        for _ in range(workers):
            self.add_worker(*options)

    def add_worker(self, *options: str) -> subprocess.Popen:
        """One more, of one core; returns when the scheduler knows it."""
        name = f"worker{len(self.processes)}"
        command = (
            "factorlib",
            "worker",
            self.address,
            "--cores",
            "1",
            "--host",
            "127.0.0.1",
            "--local-directory",
            tempfile.gettempdir(),
        )
        process = self._start(name, *command, *options)
        self._said(name, r"(Registered to):\s")
        return process

    def _start(self, name: str, *words: str) -> str | subprocess.Popen:
        environment = {**os.environ, "PYTHONPATH": str(LIBRARY), "DASK_DISTRIBUTED__COMM__TIMEOUTS__CONNECT": "60s"}
        with open(self.folder / f"{name}.log", "wb") as log:
            process = subprocess.Popen(
                [sys.executable, "-m", *words],
                env=environment,
                stdout=log,
                stderr=log,
                cwd=self.folder,
                start_new_session=True,
            )
        self.processes.append(process)
        return name if name == "scheduler" else process

    def _said(self, name: str, pattern: str) -> str:
        end = time.monotonic() + 120
        while not (found := re.search(pattern, self.log(name))):
            assert time.monotonic() < end, self.log(name)
            time.sleep(0.05)
        return found[1]

    def log(self, name: str) -> str:
        return (self.folder / f"{name}.log").read_text()

    @property
    def settings(self) -> list[str]:
        """The words that make a run use it."""
        return ["executor=dask", f"scheduler={self.address}"]

    def close(self) -> None:
        for process in reversed(self.processes):
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()


def offspring(pid: int) -> list[int]:
    """All processes below a process, parents first."""
    below: dict[int, list[int]] = {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            below.setdefault(int(stat.read_text().rpartition(")")[2].split()[1]), []).append(int(stat.parent.name))
    found = [pid]
    for one in found:
        found += below.get(one, [])
    return found[1:]


def doing(pid: int, word: str) -> bool:
    """Whether a process has that word on its command line."""
    with contextlib.suppress(OSError):
        return word.encode() in Path(f"/proc/{pid}/cmdline").read_bytes()
    return False
