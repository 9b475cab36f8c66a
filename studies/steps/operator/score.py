"""How far an operator is from exact reflection: writes <case>.json."""

from __future__ import annotations

from pathlib import Path

import msgspec

from factorlib.jsonfile import write_json
from factorlib.stage import Inputs, Progress
from studies.core.band import Band
from studies.core.operators import score_of


class Params(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Nothing to choose."""


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Sample, render, time."""
    write_json(out / f"{inputs.photo}.json", score_of(msgspec.convert(inputs.facts["dataset.case"], Band)))
