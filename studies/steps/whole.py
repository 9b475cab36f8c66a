"""The stage `solve` on all that the photos show: writes what that stage writes."""

from __future__ import annotations

from pathlib import Path

import msgspec

from factorlib.stage import Inputs, Progress
from studies.steps.solve import Params, solved


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """With the parameters that the study names."""
    facts = inputs.facts["dataset.sets"]
    given = {**msgspec.to_builtins(params), **facts["solve"]}
    solved(given, inputs["photos"] / Path(facts["folder"]).name / "urm", inputs, out, progress)
