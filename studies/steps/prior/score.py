"""How far a case's answer is from the truth, and how coloured its lights are: writes <case>.json."""

from __future__ import annotations

from pathlib import Path

import msgspec

from factorlib.images.exr import read_rgb_exr
from factorlib.jsonfile import write_json
from factorlib.stage import Inputs, Progress
from studies.core.case import Case, World
from studies.core.score import scored
from studies.core.tint import tints_of
from studies.core.world import light, materials_of
from studies.steps.spheres.worlds import light_file


class Params(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Nothing to choose: a metric that can be tuned is none."""


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Compare with all lights of the world."""
    case, world = (
        msgspec.convert(inputs.facts[f"dataset.{name}"], of) for name, of in (("case", Case), ("worlds", World))
    )
    lights = {li: light(read_rgb_exr(inputs["worlds"] / light_file(case.seed, li))) for li in range(world.lights)}
    found = scored(case, materials_of(case.seed), solved := inputs["solve"] / inputs.photo, lights)
    write_json(out / f"{inputs.photo}.json", found.score | tints_of(case, solved, lights))
