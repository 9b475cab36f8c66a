"""The stage `solve` itself, on a case: writes into <case>/ what that stage writes."""

from __future__ import annotations

from pathlib import Path

import msgspec

from factorlib.dataset.schema import LightSlice
from factorlib.reflection.network import SHIPPED
from factorlib.stage import Inputs, Progress
from stages.solve import Params
from stages.solve import main as solve
from studies.core.case import Case, light_name


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """With the parameters that the case names."""
    case = msgspec.convert(inputs.facts["dataset.case"], Case)
    lights = {light_name(li): msgspec.to_builtins(LightSlice(light_name(li), None)) for li in case.lights}
    folders = {"urm": inputs["observe"] / inputs.photo, "train": SHIPPED}
    facts = {"dataset.materials": case.material_names, "dataset.light": lights}
    (out / inputs.photo).mkdir()
    chosen = msgspec.convert({**msgspec.to_builtins(params), **case.solve}, Params)
    solve(chosen, Inputs(folders, facts, map=inputs.map, unfinished=inputs.unfinished), out / inputs.photo, progress)
