"""What a solve costs, by the number of its entries: a case is n materials in n lights, solved in a process of its own.

`python -m studies.core.cost <case as JSON>` makes the observations (`tests.scenes.problems.square`: spheres of 12 × 12 pixels, lights of
six lobes, rendered by the operator that solves, so that only size grows), solves, and prints a `Cost` as JSON.

Time      processor seconds of all threads between the start of the solve and its end, which other work on the machine hardly lengthens.
Memory    the largest resident set of the process, from its start, with the libraries that it loads; `before` is that before the solve.
"""

from __future__ import annotations

import resource
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import msgspec

STATUS = Path("/proc/self/status")


class Sized(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """side: materials, and lights;  solve: options of the solver of few lobes that differ from their defaults"""

    seed: int
    side: int
    solve: dict[str, Any] = {}

    @property
    def entries(self) -> int:
        """All are observed."""
        return self.side**2


class Cost(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """seconds: of the processor;  before, peak: resident set, bytes"""

    seconds: float
    before: int
    peak: int


def cost_of(case: Sized) -> Cost:
    """Measured in a fresh process, of this interpreter.  Raises CalledProcessError where it fails; its words go to this one's."""
    command = [sys.executable, "-m", "studies.core.cost", msgspec.json.encode(case).decode()]
    done = subprocess.run(command, stdout=subprocess.PIPE, check=True)
    return msgspec.json.decode(done.stdout, type=Cost)


def measured(case: Sized) -> Cost:
    """In this process."""
    from factorlib.model.problem import JointProblem
    from factorlib.reflection import reflection_operator
    from factorlib.solve.few_lobes.history import Run
    from factorlib.solve.few_lobes.options import FewLobes
    from factorlib.solve.few_lobes.rounds import from_nothing
    from factorlib.solve.few_lobes.solve import few_lobes
    from tests.scenes.problems import square

    operator = reflection_operator("network")
    joint = JointProblem(square(case.side, operator, case.seed), operator)
    before, start = peak_bytes(), time.process_time()
    few_lobes(joint, from_nothing(case.side), Run(msgspec.convert({**case.solve, "seed": case.seed}, FewLobes)))
    return Cost(time.process_time() - start, before, peak_bytes())


def peak_bytes() -> int:
    """The largest resident set so far; of this program alone where Linux says so, for `getrusage` begins with that of its parent."""
    if STATUS.exists():
        line = next(line for line in STATUS.read_text(encoding="ascii").splitlines() if line.startswith("VmHWM"))
        return 1024 * int(line.split()[1])
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else 1024 * peak


if __name__ == "__main__":
    print(msgspec.json.encode(measured(msgspec.json.decode(sys.argv[1], type=Sized))).decode())
