"""Answer of the stage `solve` in the comparison: <case>/materials.json, a map for each light, seconds.json.

Other methods take no time: `studies.steps.compare` runs them itself.
"""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

import msgspec
import numpy as np

from factorlib.images.exr import LAT_LONG, write_rgb_exr
from factorlib.jsonfile import write_json
from factorlib.results.materials import read_materials
from factorlib.stage import Inputs, Progress
from studies.body import photographed
from studies.errors import maps_of
from studies.spheres import materials_of, read_maps
from studies.steps import Params
from studies.steps.solve import solved
from studies.study import Comparison


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Solve a case of the method `ours`."""
    case, home = msgspec.convert(inputs.facts["dataset.case"], Comparison), out / inputs.photo
    home.mkdir()
    write_json(home / "seconds.json", 0)
    if case.method != "ours":
        return
    _, tables = photographed(case, materials_of(case.seed), read_maps(inputs["worlds"], case.seed, case.lights))
    with TemporaryDirectory() as folder:
        write_json(home / "seconds.json", solved(tables, case.solve, inputs, Path(folder), progress))
        table = read_materials(Path(folder) / "materials.json").materials
        write_json(home / "materials.json", {name: material.reflectance for name, material in table.items()})
        for light, texels in maps_of(Path(folder), case.lights).items():
            write_rgb_exr(home / f"{light}.exr", texels.astype(np.float32), LAT_LONG)
