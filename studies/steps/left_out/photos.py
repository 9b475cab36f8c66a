"""What the pipeline sees of the data set: writes masks/, align/ and urm/, as the stages of these names do."""

from __future__ import annotations

from pathlib import Path

import msgspec

from factorlib.stage import Inputs, Progress
from studies.core.left_out.photos import observe

CHECKOUT = Path(__file__).resolve().parents[3]


class Params(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Nothing to choose: the study says which photos."""


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Poses are searched as in every run of the data set."""
    facts = inputs.facts["dataset.photos"]
    observe(CHECKOUT / facts["folder"], facts["photos"], out, progress)
