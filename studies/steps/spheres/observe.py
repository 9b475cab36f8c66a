"""What a case sees: writes <case>/<photo>.parquet, as the stage `urm` does."""

from __future__ import annotations

from pathlib import Path

import msgspec

from factorlib.images.exr import read_rgb_exr
from factorlib.stage import Inputs, Progress
from factorlib.urm.observations import write_observations
from studies.core.case import Case
from studies.core.observed import observations_of
from studies.core.world import light, materials_of
from studies.steps.spheres.worlds import light_file


class Params(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Nothing to choose: the case says all."""


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Render and perturb."""
    case = msgspec.convert(inputs.facts["dataset.case"], Case)
    lights = {li: light(read_rgb_exr(inputs["worlds"] / light_file(case.seed, li))) for li in case.lights}
    (out / inputs.photo).mkdir()
    for name, seen in observations_of(case, materials_of(case.seed), lights).items():
        write_observations(out / inputs.photo / f"{name}.parquet", seen)
