"""Mitsuba's joint optimisation, on the cases that are its own: writes <case>/optimised.json, and <case>/method.json for all.

The seconds that it took, in optimised.json, are a result of this study; they differ from run to run.
"""

from __future__ import annotations

import logging
from pathlib import Path

import msgspec

from factorlib.jsonfile import write_json
from factorlib.stage import Inputs, Progress
from studies.core.baselines.case import Comparison
from studies.core.baselines.joint import optimised
from studies.core.baselines.photos import read_photos

log = logging.getLogger("factorlib.studies.optimise")


class Params(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Nothing to choose: the rate was chosen on a seed that is not reported."""


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Until it is flat; for other methods, only their name."""
    case = msgspec.convert(inputs.facts["dataset.case"], Comparison)
    (out / inputs.photo).mkdir()
    write_json(out / inputs.photo / "method.json", case.method)
    if case.method == "mitsuba":
        photos = read_photos(case, inputs["observe"] / inputs.photo)
        found = optimised(case.seed, photos, case.joint)
        if not found.flat:
            log.warning(f"Mitsuba's optimisation was ended after {len(found.losses)} steps, before its loss was flat")
        write_json(out / inputs.photo / "optimised.json", found)
