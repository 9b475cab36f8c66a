"""How far a case's answer is from the truth, and what it took: writes <case>.json."""

from __future__ import annotations

from pathlib import Path

import msgspec

from factorlib.images.exr import read_rgb_exr
from factorlib.jsonfile import read_json, write_json
from factorlib.stage import Inputs, Progress
from studies.core.case import Case, Score, World
from studies.core.score import scored
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
    write_json(out / f"{inputs.photo}.json", found.score | Score({"seconds": read_json(solved / "seconds.json")}))
