"""Run of the stage `solve` on the observations of a case: writes that stage's files and measured.json into <case>/.

measured.json holds the processor seconds of the solve, summed over threads, from reading the observations to writing
materials and lights.  For objects it also holds the mean error of the given normals.  Seconds are a measurement: they
differ from run to run.
"""

import time
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import msgspec

from factorlib.dataset.schema import LightSlice
from factorlib.evaluate.ball import octahedral_light
from factorlib.jsonfile import write_json
from factorlib.reflection.network import SHIPPED
from factorlib.stage import Inputs, Progress
from factorlib.urm.observations import Observations, write_observations
from stages import solve
from studies import objects, spheres
from studies.steps import Params
from studies.study import Case, Comparison


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Render, perturb, and solve with the parameters of the case; other methods of a comparison do not solve."""
    facts = inputs.facts["dataset.case"]
    case = msgspec.convert(facts, Comparison if "method" in facts else Case)
    (home := out / inputs.photo).mkdir()
    measured = {}
    if getattr(case, "method", "ours") == "ours":
        maps = spheres.read_maps(inputs["worlds"], case.seed, case.lights)
        lights = {li: octahedral_light(light) for li, light in maps.items()}
        materials = spheres.materials_of(case.seed, case.names)
        if case.objects:
            tables, measured["normals"] = objects.observe_objects(case, materials, lights)
        else:
            tables = spheres.observe_spheres(case, materials, lights)
        measured["seconds"] = run_solve(tables, case.solve, inputs, home, progress)
    write_json(home / "measured.json", measured)


def run_solve(
    tables: Mapping[str, Observations],
    parameters: dict[str, Any],
    inputs: Inputs,
    out: Path,
    progress: Progress,
) -> float:
    """Solve observations by the stage's parameters, each photo in a light of its own; return the processor seconds."""
    lights = {name: msgspec.to_builtins(LightSlice(name, None)) for name in tables}
    facts = {"dataset.materials": list(next(iter(tables.values())).materials), "dataset.light": lights}
    with TemporaryDirectory() as folder:
        for name, table in tables.items():
            write_observations(Path(folder) / f"{name}.parquet", table)
        folders = {"urm": Path(folder), "train": SHIPPED}
        start_s = time.process_time()
        stage_inputs = Inputs(folders, facts, map=inputs.map, unfinished=inputs.unfinished)
        solve.main(msgspec.convert(parameters, solve.Params), stage_inputs, out, progress)
        return round(time.process_time() - start_s, 2)
