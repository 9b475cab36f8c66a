"""The stage `solve` on a case, as for spheres, and the processor time it took: writes seconds.json beside its files.

The time is of all threads of this process, from observations as they lie on disk to materials and lights as they lie there.
"""

from __future__ import annotations

import time
from pathlib import Path

from factorlib.jsonfile import write_json
from factorlib.stage import Inputs, Progress
from studies.steps.spheres.solve import Params
from studies.steps.spheres.solve import main as solve


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Solve, then say how long."""
    start = time.process_time()
    solve(params, inputs, out, progress)
    write_json(out / inputs.photo / "seconds.json", time.process_time() - start)
