"""The rendered sets of chairs of all seeds, as `factorlib.generate` makes them: writes <seed>/, each a data set.

Photographs have all bounces, a mesh coarser than what was photographed, clipped pixels.  A set that is done outlives a kill of the step.
Mitsuba's scalar variant traces, which every machine has.
"""

from __future__ import annotations

import os
import shutil
from pathlib import Path

from factorlib.generate.eames import SET, Parameters, generate
from factorlib.stage import Inputs, Progress, silent
from studies.steps import Params


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Render every set that is not there yet; none for a study of a data set of this checkout."""
    os.environ["FACTORLIB_MITSUBA"] = "scalar_rgb"  # read where Mitsuba is first used
    facts, kept = inputs.facts["dataset.sets"], inputs.unfinished or out
    kept.mkdir(parents=True, exist_ok=True)
    seeds = facts.get("seeds", [])
    for number, seed in enumerate(seeds):
        progress(number, len(seeds), f"set {seed}")
        if not (done := kept / str(seed)).exists():
            shutil.rmtree(draft := kept / "draft", ignore_errors=True)
            draft.mkdir()
            size = Parameters(**{field: facts[field] for field in ("width", "height", "light_rows", "spp")})
            generate(draft, seed, [], size, silent, SET.shots[: facts["shots"]])
            draft.rename(done)
        if kept != out:
            shutil.copytree(done, out / str(seed))
