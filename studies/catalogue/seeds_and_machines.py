"""Seeds and machines: how far do the numbers that README.md quotes of data/synthetic lie apart?

Varied     seeds of the solve, ten of them; and the instructions that numerical libraries may use:
           fixed   what every run has (`factorlib.arithmetic`): AVX2, the same on processors of any maker
           all     what this processor has
           least   kernels for processors without AVX2 in NumPy, OpenBLAS and PyTorch; the compiled network stays as it is
Measured   the numbers of `studies.measured.reference`, of the whole pipeline on data/synthetic.

`python -m studies.catalogue.seeds_and_machines <case as JSON>` measures one case.  Libraries read which instructions they may use when
they are loaded, so that each case needs a process.
"""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from factorlib.arithmetic import VARIABLES
from factorlib.jsonfile import write_json
from factorlib.stage import Inputs, Progress
from studies.steps import Params
from studies.study import Scale, Score, Setting, Study

DATA = Path(__file__).resolve().parents[2] / "data" / "synthetic"
INSTRUCTIONS = {
    "fixed": VARIABLES,
    "all": {},
    "least": {
        "NPY_DISABLE_CPU_FEATURES": "X86_V3 X86_V4 AVX512_ICL AVX512_SPR",
        "OPENBLAS_CORETYPE": "Nehalem",
        "ATEN_CPU_CAPABILITY": "default",
        "MKL_CBWR": "COMPATIBLE",
    },
}
RUNS = {  # instructions and the first seed by label: as they are with seeds of two runs, then others with the seeds of the first
    "full": {"seeds 0 to 4": ("fixed", 0), "seeds 5 to 9": ("fixed", 5), "all instructions": ("all", 0), "without AVX2": ("least", 0)},
    "quick": {"as it is": ("fixed", 0)},
}  # fmt: skip


def hash_of_data() -> str:
    """Of all files of data/synthetic."""
    files = sorted(file for file in DATA.rglob("*") if file.is_file())
    listed = [(file.relative_to(DATA).as_posix(), hashlib.sha256(file.read_bytes()).hexdigest()) for file in files]
    return hashlib.sha256(repr(listed).encode()).hexdigest()[:16]


def settings(scale: Scale) -> list[Setting]:
    """Of the scale's runs."""
    fields = {"data": hash_of_data(), "solve": scale.solve}
    return [
        Setting(
            f"{which}-{first}",
            label,
            lambda k, which=which, first=first: {"seed": first + k, "instructions": which, **fields},
        )
        for label, (which, first) in RUNS[scale.name].items()
    ]


def notes(table: Any) -> list[str]:
    """The spread over all seeds as runs are, then what other instructions change of the same seeds."""
    from studies.conclusion import MEASURES, spread

    fixed, sentences = [row for row in table.rows if row.name.startswith("fixed")], []
    for m in table.measures:
        values = [v for row in fixed for v in row.cells[m].values.values()]
        s, start = spread(values), f"{MEASURES[m].label}: "
        apart = "" if s.deviation is None else f", deviation {s.deviation:.2g}, {min(values):.4g} to {max(values):.4g}"
        sentences.append(f"{start}{s.mean:.4g} on average over {s.seeds} seed{'s' * (s.seeds > 1)}{apart}.")
    for row in (row for row in table.rows if row not in fixed):
        pairs = {m: (row.cells[m].values, fixed[0].cells[m].values) for m in table.measures}
        apart = {m: max(abs(v - before[seed]) for seed, v in now.items()) for m, (now, before) in pairs.items()}
        most = "; ".join(f"{MEASURES[m].label} by {v:.2g}" for m, v in apart.items() if v)
        differ = (
            f"numbers of the same seed differ at most so: {most}"
            if most
            else "every number is the same to the last digit"
        )
        sentences.append(f"{row.label}: {differ}.")
    return sentences


STUDY = Study(
    name="seeds-and-machines",
    title="Seeds and machines",
    question="How far do the numbers that README.md quotes of data/synthetic lie apart?",
    paper="Nothing.",
    varied="seeds of the solve, and instructions",
    measures=(
        "materials.worst_roughness", "materials.worst_diffuse", "materials.worst_specular", "resynthesis.worst_psnr_linear_db",
        "relighting.mean.scalar_per_set.in_true_light.psnr_tonemapped_db", "light.mean.channel_per_photo.glossy.estimate.rmse",
    ),
    settings=settings,
    steps=(),
    notes=notes,
)  # fmt: skip


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Measure a case in another process: writes <case>.json.  Raises CalledProcessError where that fails."""
    case = inputs.facts["dataset.case"]
    free = {name: value for name, value in os.environ.items() if name not in VARIABLES}
    command = [sys.executable, "-m", __spec__.name, json.dumps(case)]
    environment = free | INSTRUCTIONS[case["instructions"]]
    done = subprocess.run(command, env=environment, stdout=subprocess.PIPE, check=True)
    write_json(out / f"{inputs.photo}.json", Score(json.loads(done.stdout.splitlines()[-1])))


def measured(case: dict[str, Any]) -> dict[str, float]:
    """The numbers by their path in metrics.json, in this process."""
    from factorlib.evaluate.table import value_at
    from factorlib.jsonfile import read_json
    from stages import align, evaluate, export, masks, render, solve, urm
    from studies.measured.reference import NUMBERS
    from studies.steps.photos import run_stages

    stages = (masks, align, urm, solve, export, render, evaluate)
    with tempfile.TemporaryDirectory() as folder:
        run_stages(DATA, Path(folder), stages, {"solve": {**case["solve"], "seed": case["seed"]}})
        metrics = read_json(Path(folder) / "evaluate" / "metrics.json")
    return {path: value_at(metrics, path) for path in NUMBERS}


if __name__ == "__main__":
    import torch

    torch.set_num_threads(1)
    print(json.dumps(measured(json.loads(sys.argv[1]))))
