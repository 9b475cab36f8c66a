"""The stage `solve` on all that the photos show: writes what that stage writes."""

from __future__ import annotations

from pathlib import Path

import msgspec

from factorlib.dataset.schema import LightSlice
from factorlib.reflection.network import SHIPPED
from factorlib.stage import Inputs, Progress
from factorlib.urm.observations import read_observations
from stages.solve import Params
from stages.solve import main as solve


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """With the parameters that the study names."""
    solved(params, inputs, inputs["photos"] / "urm", out, progress)


def solved(params: Params, inputs: Inputs, urm: Path, out: Path, progress: Progress) -> None:
    """Solve the observations in the folder `urm`."""
    files = sorted(urm.glob("*.parquet"))
    lights = {file.stem: msgspec.to_builtins(LightSlice(file.stem, None)) for file in files}
    facts = {"dataset.materials": list(read_observations(files[0]).materials), "dataset.light": lights}
    chosen = msgspec.convert({**msgspec.to_builtins(params), **inputs.facts["dataset.photos"]["solve"]}, Params)
    solve(chosen, Inputs({"urm": urm, "train": SHIPPED}, facts, map=inputs.map), out, progress)
