"""What a case costs, measured: writes <case>.json."""

from __future__ import annotations

from pathlib import Path

import msgspec

from factorlib.jsonfile import write_json
from factorlib.stage import Inputs, Progress
from studies.core.case import Score
from studies.core.cost import Sized, cost_of

GB = 1e9


class Params(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Nothing to choose."""


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Solve in another process."""
    case = msgspec.convert(inputs.facts["dataset.case"], Sized)
    cost = cost_of(case)
    values = {
        "seconds": cost.seconds,
        "seconds_an_entry": cost.seconds / case.entries,
        "peak": cost.peak / GB,
        "grown": (cost.peak - cost.before) / GB,
    }
    write_json(out / f"{inputs.photo}.json", Score(values))
