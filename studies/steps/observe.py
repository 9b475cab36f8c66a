"""What a case observes: writes <case>/<photo>.parquet, as the stage `urm` does.

Of objects also <case>/normals.json, the mean error of their normals, and, for a solve that starts from an earlier one,
<case>/earlier/<photo>.parquet of all photos but the last.
"""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np

from factorlib.jsonfile import write_json
from factorlib.stage import Inputs, Progress
from factorlib.urm.observations import write_observations
from studies import body, objects, spheres
from studies.steps import Params
from studies.study import Case, Comparison


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Render and perturb."""
    facts, worlds, folder = inputs.facts["dataset.case"], inputs["worlds"], out / inputs.photo
    case = msgspec.convert(facts, Comparison if "method" in facts else Case)
    materials = spheres.materials_of(case.seed, case.names)
    (folder / "earlier").mkdir(parents=True)
    if isinstance(case, Comparison):
        maps = spheres.read_maps(worlds, case.seed, case.lights)
        tables = body.observations_of(case, body.photographed(case, materials, maps))
    elif case.objects is None:
        tables = spheres.observations_of(case, materials, spheres.read_lights(worlds, case.seed, case.lights))
    else:
        photos = objects.observed(case, materials, spheres.read_lights(worlds, case.seed, case.lights))
        tables = {name: objects.together(entries) for name, entries in photos.items()}
        errors = [each.normal_error_deg for entries in photos.values() for each in entries]
        write_json(folder / "normals.json", float(np.mean(errors)))
    for number, (name, table) in enumerate(tables.items()):
        write_observations(folder / f"{name}.parquet", table)
        if case.objects and case.objects.start == "earlier" and number < len(tables) - 1:
            write_observations(folder / "earlier" / f"{name}.parquet", table)
