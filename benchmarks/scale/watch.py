"""What a tree of processes costs, by what each of them is for: processor seconds and peak memory, read from /proc while they run."""

from __future__ import annotations

import contextlib
import os
import threading
from pathlib import Path

import msgspec

EVERY = 0.5  # seconds between two looks
TICKS = os.sysconf("SC_CLK_TCK")
ROLES = {  # word of the command line -> what it is for; the first that fits
    "dask_scheduler": "scheduler",
    "factorlib.runner.child": "steps",
    "dask_worker": "workers",
    "spawn_main": "workers",
    "resource_tracker": "workers",
    "benchmarks.scale.project": "run",
}


class Cost(msgspec.Struct):
    """cpu_seconds: of all processes of a role;  peak_mb: of the largest one;  processes: how many there were"""

    cpu_seconds: float = 0.0
    peak_mb: float = 0.0
    processes: int = 0


class Watch:
    """Looks at this process's offspring until it is closed."""

    def __init__(self) -> None:
        self._seen: dict[int, tuple[str, float, float]] = {}
        self.most_mb = 0.0  # of all processes together, pages that they share counted for each
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._look_often, daemon=True)
        self._thread.start()

    def close(self) -> dict[str, Cost]:
        """Stop looking; the cost by role."""
        self._over.set()
        self._thread.join()
        costs: dict[str, Cost] = {}
        for role, cpu, peak in self._seen.values():
            cost = costs.setdefault(role, Cost())
            cost.cpu_seconds, cost.peak_mb, cost.processes = (
                cost.cpu_seconds + cpu,
                max(cost.peak_mb, peak),
                cost.processes + 1,
            )
        return costs

    def _look_often(self) -> None:
        while not self._over.wait(EVERY):
            self._look()

    def _look(self) -> None:
        together = 0.0
        for pid in _offspring(os.getpid()):
            with contextlib.suppress(OSError, ValueError, LookupError):
                fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
                status = dict(line.split(":", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines())
                command = Path(f"/proc/{pid}/cmdline").read_text()
                role = next((role for word, role in ROLES.items() if word in command), "other")
                self._seen[pid] = role, (int(fields[11]) + int(fields[12])) / TICKS, _mb(status["VmHWM"])
                together += _mb(status["VmRSS"])
        self.most_mb = max(self.most_mb, together)


def _mb(text: str) -> float:
    return int(text.split()[0]) / 1024


def _offspring(pid: int) -> list[int]:
    below: dict[int, list[int]] = {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError, ValueError):
            below.setdefault(int(stat.read_text().rpartition(")")[2].split()[1]), []).append(int(stat.parent.name))
    found = [pid]
    for one in found:
        found += below.get(one, [])
    return found[1:]
