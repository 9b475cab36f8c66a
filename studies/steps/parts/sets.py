"""The photographed sets of all seeds, rendered: writes <seed>/, each a data set.

A set that is done outlives a kill of the step.  Mitsuba's scalar variant traces, which every machine has.
"""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import msgspec

from factorlib.stage import Inputs, Progress
from studies.core.chairs import make_set
from studies.core.part import chairs_of
from studies.core.study import Scale


class Params(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Nothing to choose: the scale says all."""


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Render every set that is not there yet."""
    os.environ["FACTORLIB_MITSUBA"] = "scalar_rgb"  # read where Mitsuba is first used
    chairs = chairs_of(msgspec.convert(inputs.facts["dataset.study"]["scale"], Scale))
    kept = inputs.unfinished or out
    kept.mkdir(parents=True, exist_ok=True)
    for number, seed in enumerate(chairs.seeds):
        progress(number, len(chairs.seeds), f"set {seed}")
        if not (done := kept / str(seed)).exists():
            shutil.rmtree(draft := kept / "draft", ignore_errors=True)
            draft.mkdir()
            make_set(draft, seed, chairs)
            draft.rename(done)
        if kept != out:
            shutil.copytree(done, out / str(seed))
