"""The stage `solve` itself, on the cases that are its own: writes into <case>/ what that stage writes, taken.json, and method.json for all.

taken.json has the seconds that it took, of the processor: they are a result of this study, and the only numbers that differ from run to run.
"""

from __future__ import annotations

from pathlib import Path

import msgspec

from benchmarks.tools import Clock
from factorlib.dataset.schema import LightSlice
from factorlib.jsonfile import write_json
from factorlib.reflection.network import SHIPPED
from factorlib.stage import Inputs, Progress
from stages.solve import Params
from stages.solve import main as solve
from studies.core.baselines.case import Comparison
from studies.core.case import light_name


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """With the parameters that the case names; for other methods, only their name."""
    case = msgspec.convert(inputs.facts["dataset.case"], Comparison)
    (out / inputs.photo).mkdir()
    write_json(out / inputs.photo / "method.json", case.method)
    if case.method != "ours":
        return
    lights = {light_name(li): msgspec.to_builtins(LightSlice(light_name(li), None)) for li in case.lights}
    folders = {"urm": inputs["observe"] / inputs.photo, "train": SHIPPED}
    facts = {"dataset.materials": case.material_names, "dataset.light": lights}
    chosen, clock = msgspec.convert({**msgspec.to_builtins(params), **case.solve}, Params), Clock()
    solve(chosen, Inputs(folders, facts, map=inputs.map, unfinished=inputs.unfinished), out / inputs.photo, progress)
    write_json(out / inputs.photo / "taken.json", clock.taken())
