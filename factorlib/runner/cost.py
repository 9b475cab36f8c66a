"""What a step cost: wall and processor seconds, peak memory, and the machine it ran on."""

from __future__ import annotations

import contextlib
import datetime
import os
import platform
import resource
import time


class Meter:
    """Started where it is made."""

    def __init__(self) -> None:
        with contextlib.suppress(OSError), open("/proc/self/clear_refs", "w") as stream:  # Linux counts the peak anew
            stream.write("5")
        self.started = datetime.datetime.now(datetime.UTC).isoformat(timespec="milliseconds")
        self.wall, self.cpu = time.perf_counter(), _cpu_seconds()

    def read(self, threads: int, cores: int) -> dict:
        """Cost since the meter was made: wall and processor seconds, peak memory in MB (2^20 bytes), and facts of the machine."""
        facts = {"system": platform.system(), "processor": platform.machine(), "cores": os.cpu_count()}
        return {
            "started": self.started,
            "seconds": round(time.perf_counter() - self.wall, 3),
            "cpu_seconds": round(_cpu_seconds() - self.cpu, 3),
            "memory_mb": round(_peak_bytes() / 2**20, 1),
            "threads": threads,
            "cores": cores,
            "machine": facts | {"python": platform.python_version()},
        }


def _cpu_seconds() -> float:
    usage = map(resource.getrusage, (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(one.ru_utime + one.ru_stime for one in usage)


def _peak_bytes() -> int:
    try:
        with open("/proc/self/status") as stream:
            return next(int(line.split()[1]) * 1024 for line in stream if line.startswith("VmHWM"))
    except (OSError, StopIteration):
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return peak if platform.system() == "Darwin" else peak * 1024
