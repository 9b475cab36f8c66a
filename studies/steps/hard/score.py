"""What becomes of a hard case: writes <case>.json."""

from __future__ import annotations

from pathlib import Path

import msgspec

from factorlib.jsonfile import write_json
from factorlib.stage import Inputs, Progress
from studies.core.hard import Hard
from studies.core.hardness import score_of


class Params(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Nothing to choose."""


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Measure."""
    write_json(out / f"{inputs.photo}.json", score_of(msgspec.convert(inputs.facts["dataset.case"], Hard)))
