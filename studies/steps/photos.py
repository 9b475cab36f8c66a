"""Observations of photos of data sets, by the stages `masks`, `align` and `urm` themselves.

Each stage writes into a folder of its own in <set>/.

Sets are one of this checkout, or rendered sets of chairs of all seeds, as `factorlib.generate` makes them, which
<set>/data keeps: photographs have all bounces, a mesh coarser than what was photographed, clipped pixels. Mitsuba's
scalar variant traces, which every machine has.
"""

import os
from pathlib import Path

from factorlib.dataset.read import read_dataset
from factorlib.generate.eames import SET, ChairSetOptions, generate
from factorlib.scenes.stage_runs import CHECKOUT, run_stages
from factorlib.stage import Inputs, Progress, silent
from stages import align, masks, urm
from studies.steps import Params


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Observe all rendered sets, or some photos of a data set of this checkout; poses are searched as in every run."""
    facts = inputs.facts["dataset.sets"]
    if "folder" in facts:
        folder = CHECKOUT / facts["folder"]
        return run_stages(read_dataset(folder), out / folder.name, (masks, align, urm), photos=facts["photos"])
    os.environ["FACTORLIB_MITSUBA"] = "scalar_rgb"  # read where Mitsuba is first used
    size = ChairSetOptions(**{field: facts[field] for field in ("width", "height", "light_rows", "spp")})
    for number, seed in enumerate(facts["seeds"]):
        progress(number, len(facts["seeds"]), f"set {seed}")
        (data := out / str(seed) / "data").mkdir(parents=True)
        generate(data, seed, [], size, silent, SET.shots[: facts["shots"]])
        run_stages(read_dataset(data), out / str(seed), (masks, align, urm))
    return None
