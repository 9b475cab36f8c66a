"""Solve a set with a part switched off, and compare: writes <case>.json."""

from __future__ import annotations

from pathlib import Path

import msgspec

from factorlib.jsonfile import write_json
from factorlib.stage import Inputs, Progress
from studies.core.chairs import score_of
from studies.core.part import Part


class Params(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Nothing to choose: a metric that can be tuned is none."""


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Solve and compare."""
    case = msgspec.convert(inputs.facts["dataset.case"], Part)
    folder = str(case.seed)
    write_json(
        out / f"{inputs.photo}.json", score_of(case, inputs["sets"] / folder, inputs["observe"] / folder / "urm")
    )
