"""data/synthetic solved with some seed by some of the instructions that this processor has: a case, and the process that measures it.

`python -m studies.core.machine <case as JSON>` runs the stages `masks` to `evaluate`, in a folder that goes, and prints the numbers of
`benchmarks.reference` as JSON.  Libraries read which instructions they may use when they are loaded, so that each case needs a process.

    fixed     what every run has (`factorlib.arithmetic`): AVX2, the same on processors of any maker
    all       what this processor has
    least     kernels for processors without AVX2 in NumPy, OpenBLAS and PyTorch; the compiled network stays as it is
"""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Literal

import msgspec

from factorlib.arithmetic import VARIABLES

DATA = Path(__file__).resolve().parents[2] / "data" / "synthetic"
Instructions = Literal["fixed", "all", "least"]
SET: dict[Instructions, dict[str, str]] = {
    "fixed": VARIABLES,
    "all": {},
    "least": {
        "NPY_DISABLE_CPU_FEATURES": "X86_V3 X86_V4 AVX512_ICL AVX512_SPR",
        "OPENBLAS_CORETYPE": "Nehalem",
        "ATEN_CPU_CAPABILITY": "default",
        "MKL_CBWR": "COMPATIBLE",
    },
}


class Machine(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """data: of what it is solved, a hash;  solve: parameters of the stage that differ from their defaults"""

    seed: int
    instructions: Instructions
    data: str
    solve: dict[str, float | int | str] = {}


def hash_of_data() -> str:
    """Of all files of data/synthetic."""
    files = sorted(file for file in DATA.rglob("*") if file.is_file())
    listed = [(file.relative_to(DATA).as_posix(), hashlib.sha256(file.read_bytes()).hexdigest()) for file in files]
    return hashlib.sha256(repr(listed).encode()).hexdigest()[:16]


def numbers_of(case: Machine) -> dict[str, float]:
    """By path in metrics.json.  Raises CalledProcessError where the process fails."""
    free = {name: value for name, value in os.environ.items() if name not in VARIABLES}
    command = [sys.executable, "-m", "studies.core.machine", msgspec.json.encode(case).decode()]
    done = subprocess.run(command, env=free | SET[case.instructions], stdout=subprocess.PIPE, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def measured(case: Machine) -> dict[str, float]:
    """In this process."""
    from benchmarks.reference import NUMBERS
    from factorlib.evaluate.table import value_at
    from factorlib.jsonfile import read_json
    from studies.core.pipeline import run_stages

    with tempfile.TemporaryDirectory() as folder:
        run_stages(DATA, Path(folder), {"solve": {**case.solve, "seed": case.seed}})
        metrics = read_json(Path(folder) / "evaluate" / "metrics.json")
    return {path: value_at(metrics, path) for path in NUMBERS}


if __name__ == "__main__":
    import torch

    torch.set_num_threads(1)
    print(json.dumps(measured(msgspec.json.decode(sys.argv[1], type=Machine))))
