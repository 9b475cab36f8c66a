"""Observations of rendered sets of chairs, by the stages `masks`, `align` and `urm` themselves.

Each stage writes into a folder of its own in <seed>/.  Sets are made by `factorlib.generate`, and kept in <seed>/data:
photographs have all bounces, a mesh coarser than what was photographed, clipped pixels.  Mitsuba's scalar variant
traces, which every machine has.
"""

import os
from pathlib import Path

from factorlib.dataset.read_dataset import read_dataset
from factorlib.generate.eames import SET, ChairSetOptions, generate
from factorlib.scenes.stage_runs import run_stages
from factorlib.stage import Inputs, Progress, silent
from stages import align, masks, urm
from studies.steps import Params


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Generate and observe all sets; poses are searched as in every run."""
    facts = inputs.facts["dataset.sets"]
    os.environ["FACTORLIB_MITSUBA"] = "scalar_rgb"  # read where Mitsuba is first used
    size = ChairSetOptions(**{field: facts[field] for field in ("width", "height", "light_rows", "spp")})
    for number, seed in enumerate(facts["seeds"]):
        progress(number, len(facts["seeds"]), f"set {seed}")
        (data := out / str(seed) / "data").mkdir(parents=True)
        generate(data, seed, [], size, silent, SET.shots[: facts["shots"]])
        run_stages(read_dataset(data), out / str(seed), (masks, align, urm))
