"""The stage `solve` without one chair after the other: writes <case>/left_out.json, and for each shell that is left out <case>/<shell>/,
what that stage writes."""

from __future__ import annotations

import tempfile
from pathlib import Path

import msgspec

from factorlib.jsonfile import write_json
from factorlib.stage import Inputs, Progress
from factorlib.urm.observations import Observations, read_observations, write_observations
from studies.steps.solve import Params, solved


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Nothing is solved for a case that leaves nothing out."""
    case, facts, home = inputs.facts["dataset.case"], inputs.facts["dataset.sets"], out / inputs.photo
    home.mkdir()
    given = {**msgspec.to_builtins(params), **facts["solve"]}
    shells = case["shells"] if case["prediction"] == "left out" else []
    for shell in shells:
        (home / shell).mkdir()
        with tempfile.TemporaryDirectory() as folder:
            for file in sorted((inputs["photos"] / Path(facts["folder"]).name / "urm").glob("*.parquet")):
                table = read_observations(file)
                table = without(table, shell) if file.stem == case["photo"] else table
                write_observations(Path(folder) / file.name, table)
            alone = msgspec.structs.replace(inputs, unfinished=None)  # solves must not resume each other's
            solved(given, Path(folder), alone, home / shell, progress)
    write_json(home / "left_out.json", shells)


def without(table: Observations, material: str) -> Observations:
    """A photo's observations but for those of a material."""
    return table.take(table.material != table.materials.index(material))
