"""How far a case's answer is from the truth: writes <case>.json, and for pictures balls-<case>.png and matrix-<case>.png."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np

from factorlib.images.exr import read_rgb_exr
from factorlib.images.picture import write_png
from factorlib.jsonfile import read_json, write_json
from factorlib.stage import Inputs, Progress
from studies.core.case import Score, World
from studies.core.objects.case import ObjectsCase
from studies.core.objects.show import column, matrix
from studies.core.objects.world import materials_of, with_one_light_more
from studies.core.score import scored
from studies.core.world import light
from studies.steps.spheres.worlds import light_file


class Params(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Nothing to choose: a metric that can be tuned is none."""


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Compare with all lights of the world."""
    case, world = (
        msgspec.convert(inputs.facts[f"dataset.{name}"], of) for name, of in (("case", ObjectsCase), ("worlds", World))
    )
    count = with_one_light_more(world).lights
    lights = {li: light(read_rgb_exr(inputs["worlds"] / light_file(case.seed, li))) for li in range(count)}
    found = scored(case, materials_of(case.seed), inputs["solve"] / inputs.photo, lights)
    measured = Score(
        {
            "normals": read_json(inputs["observe"] / inputs.photo / "normals.json"),
            "seconds": read_json(inputs["solve"] / inputs.photo / "seconds.json"),
        }
    )
    write_json(out / f"{inputs.photo}.json", found.score | measured)
    if case.seed == world.seeds[0]:
        last = count - 1  # a light that hardly any case has seen
        write_png(
            out / f"balls-{inputs.photo}.png",
            np.concatenate([column(found.pictures, last, true) for true in (True, False)], axis=1),
        )
        both = [matrix(found.pictures, true) for true in (True, False)]
        write_png(
            out / f"matrix-{inputs.photo}.png",
            np.concatenate([both[0], np.zeros((len(both[0]), 24, 3), np.uint8), both[1]], axis=1),
        )
