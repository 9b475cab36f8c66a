"""The stage `solve` without one chair after the other: writes <case>/left_out.json, and for each shell that is left out <case>/<shell>/,
what that stage writes."""

from __future__ import annotations

import tempfile
from pathlib import Path

import msgspec

from factorlib.jsonfile import write_json
from factorlib.stage import Inputs, Progress
from factorlib.urm.observations import read_observations, write_observations
from stages.solve import Params
from studies.core.left_out.case import LeftOutCase
from studies.core.left_out.photos import without
from studies.steps.left_out.whole import solved


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Nothing is solved for a case that leaves nothing out."""
    case = msgspec.convert(inputs.facts["dataset.case"], LeftOutCase)
    home = out / inputs.photo
    home.mkdir()
    shells = case.shells if case.prediction == "left out" else ()
    for shell in shells:
        (home / shell).mkdir()
        with tempfile.TemporaryDirectory() as folder:
            for file in sorted((inputs["photos"] / "urm").glob("*.parquet")):
                seen = read_observations(file)
                write_observations(Path(folder) / file.name, without(seen, shell) if file.stem == case.photo else seen)
            solved(params, inputs, Path(folder), home / shell, progress)
    write_json(home / "left_out.json", list(shells))
