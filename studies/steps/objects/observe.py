"""What a case sees: writes <case>/<photo>.parquet, as the stage `urm` does, <case>/normals.json and, for a solve that starts from an
earlier one, <case>/earlier/<photo>.parquet of all photos but the last."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np

from factorlib.images.exr import read_rgb_exr
from factorlib.jsonfile import write_json
from factorlib.stage import Inputs, Progress
from factorlib.urm.observations import write_observations
from studies.core.objects.case import ObjectsCase
from studies.core.objects.observed import observations_of, together
from studies.core.objects.world import materials_of
from studies.core.world import light
from studies.steps.spheres.worlds import light_file


class Params(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Nothing to choose: the case says all."""


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Render, perturb, and fit poses where the case says so."""
    case = msgspec.convert(inputs.facts["dataset.case"], ObjectsCase)
    lights = {li: light(read_rgb_exr(inputs["worlds"] / light_file(case.seed, li))) for li in case.lights}
    photos = observations_of(case, materials_of(case.seed), lights)
    folder = out / inputs.photo
    (folder / "earlier").mkdir(parents=True)
    for name, entries in photos.items():
        write_observations(folder / f"{name}.parquet", together(entries))
    if case.start == "earlier":
        for name in list(photos)[:-1]:
            write_observations(folder / "earlier" / f"{name}.parquet", together(photos[name]))
    write_json(
        folder / "normals.json",
        float(np.mean([each.normal_error_deg for entries in photos.values() for each in entries])),
    )
