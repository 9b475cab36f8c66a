"""What a step cost: wall and processor seconds, peak memory, and the machine it ran on."""

from __future__ import annotations

import datetime
import os
import platform
import resource
import time


class Meter:
    """Started where it is made."""

    def __init__(self) -> None:
        _reset_peak()
        self.started = datetime.datetime.now(datetime.UTC).isoformat(timespec="milliseconds")
        self.wall, self.cpu = time.perf_counter(), _cpu_seconds()

    def read(self, threads: int, cores: int) -> dict:
        """Cost since the meter was made: wall and processor seconds, peak memory in MB (2^20 bytes), and facts of the machine."""
        return {
            "started": self.started,
            "seconds": round(time.perf_counter() - self.wall, 3),
            "cpu_seconds": round(_cpu_seconds() - self.cpu, 3),
            "memory_mb": round(_peak_bytes() / 2**20, 1),
            "threads": threads,
            "cores": cores,
            "machine": {
                "system": platform.system(),
                "processor": platform.machine(),
                "cores": os.cpu_count(),
                "python": platform.python_version(),
            },
        }


def _cpu_seconds() -> float:
    return sum(
        resource.getrusage(who).ru_utime + resource.getrusage(who).ru_stime
        for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    )


def _reset_peak() -> None:
    """Linux can start counting anew; elsewhere the peak is that of the worker so far."""
    try:
        with open("/proc/self/clear_refs", "w") as stream:
            stream.write("5")
    except OSError:
        pass


def _peak_bytes() -> int:
    try:
        with open("/proc/self/status") as stream:
            return next(int(line.split()[1]) * 1024 for line in stream if line.startswith("VmHWM"))
    except (OSError, StopIteration):
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return peak if platform.system() == "Darwin" else peak * 1024
