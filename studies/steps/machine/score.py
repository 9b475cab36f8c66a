"""The numbers of data/synthetic by a case's seed and instructions: writes <case>.json."""

from __future__ import annotations

from pathlib import Path

import msgspec

from factorlib.jsonfile import write_json
from factorlib.stage import Inputs, Progress
from studies.core.case import Score
from studies.core.machine import Machine, numbers_of


class Params(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Nothing to choose."""


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """In another process."""
    write_json(out / f"{inputs.photo}.json", Score(numbers_of(msgspec.convert(inputs.facts["dataset.case"], Machine))))
