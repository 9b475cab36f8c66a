"""The stage `solve` itself, on a case: writes into <case>/ what that stage writes, and seconds.json.

seconds.json holds the processor seconds of the solve: a measurement, so the one file of a study that differs from run to run.
What was solved to start from does not count in it; that solution lies in <case>/earlier/.
"""

from __future__ import annotations

import time
from pathlib import Path

import msgspec

from factorlib.dataset.schema import LightSlice
from factorlib.jsonfile import write_json
from factorlib.reflection.network import SHIPPED
from factorlib.stage import Inputs, Progress
from stages.solve import Params
from stages.solve import main as solve
from studies.core.case import light_name
from studies.core.objects.case import ObjectsCase
from studies.core.objects.treatment import robust_loss


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """With the parameters that the case names, from nothing or from the solution of all photos but the last."""
    case = msgspec.convert(inputs.facts["dataset.case"], ObjectsCase)
    chosen = msgspec.convert({**msgspec.to_builtins(params), **case.solve}, Params)
    urm, home, start = inputs["observe"] / inputs.photo, out / inputs.photo, {}
    home.mkdir()
    if case.start == "earlier":
        (home / "earlier").mkdir()
        solve(chosen, _inputs(inputs, case, {"urm": urm / "earlier"}), home / "earlier", progress)
        start = {"start": home / "earlier"}
    began = time.process_time()
    with robust_loss(case.robust):
        solve(chosen, _inputs(inputs, case, {"urm": urm, **start}), home, progress)
    write_json(home / "seconds.json", round(time.process_time() - began, 2))


def _inputs(inputs: Inputs, case: ObjectsCase, folders: dict[str, Path]) -> Inputs:
    """As the stage has them.  No journal: the two solves of a case must not resume each other's."""
    lights = {light_name(li): msgspec.to_builtins(LightSlice(light_name(li), None)) for li in case.lights}
    facts = {"dataset.materials": case.material_names, "dataset.light": lights}
    return Inputs({**folders, "train": SHIPPED}, facts, map=inputs.map)
