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

import json
import os
import sys
import tempfile
from pathlib import Path
from typing import Any

from factorlib.arithmetic import VARIABLES
from factorlib.jsonfile import write_json
from factorlib.stage import Inputs, Progress
from studies.measured.tools import apart
from studies.steps import Params
from studies.study import Scale, Score, Setting, Study

FOLDER = "data/synthetic"
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


def settings(scale: Scale) -> list[Setting]:
    """Of the scale's runs."""
    return [
        Setting(f"{which}-{first}", label, lambda k, of=(which, first): {"seed": of[1] + k, "instructions": of[0], "solve": scale.solve})
        for label, (which, first) in RUNS[scale.name].items()
    ]  # fmt: skip


def notes(table: Any) -> list[str]:
    """The spread over all seeds as runs are, then what other instructions change of the same seeds."""
    from studies.conclusion import farthest, label, spread

    fixed, sentences = [row for row in table.rows if row.name.startswith("fixed")], []
    for m in table.measures:
        values = [v for row in fixed for v in row.cells[m].values.values()]
        s = spread(values)
        apart = "" if s.deviation is None else f", deviation {s.deviation:.2g}, {min(values):.4g} to {max(values):.4g}"
        sentences.append(f"{label(m)}: {s.mean:.4g} on average over {s.seeds} seed{'s' * (s.seeds > 1)}{apart}.")
    for row in (row for row in table.rows if row not in fixed):
        both = ({m: of.cells[m].values for m in table.measures} for of in (row, fixed[0]))
        sentences.append(f"{row.label}: {farthest(*both)}.")
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
    sets=lambda scale: {"folder": FOLDER},
    notes=notes,
)  # fmt: skip


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Measure a case in another process: writes <case>.json.  Raises CalledProcessError where that fails."""
    case = inputs.facts["dataset.case"]
    free = {name: value for name, value in os.environ.items() if name not in VARIABLES}
    values = apart(__spec__.name, case, free | INSTRUCTIONS[case["instructions"]])
    write_json(out / f"{inputs.photo}.json", Score(values))


def measured(case: dict[str, Any]) -> dict[str, float]:
    """The numbers by their path in metrics.json, in this process."""
    from factorlib.dataset.read import read_dataset
    from factorlib.evaluate.table import value_at
    from factorlib.jsonfile import read_json
    from stages import align, evaluate, export, masks, render, solve, urm
    from studies.measured.reference import NUMBERS
    from studies.steps.photos import CHECKOUT, run_stages

    stages = (masks, align, urm, solve, export, render, evaluate)
    with tempfile.TemporaryDirectory() as folder:
        run_stages(
            read_dataset(CHECKOUT / FOLDER), Path(folder), stages, {"solve": {**case["solve"], "seed": case["seed"]}}
        )
        metrics = read_json(Path(folder) / "evaluate" / "metrics.json")
    return {path: value_at(metrics, path) for path in NUMBERS}


if __name__ == "__main__":
    import torch

    torch.set_num_threads(1)
    print(json.dumps(measured(json.loads(sys.argv[1]))))
