"""What the study comes to; its figure has time across and error up: writes table.csv, table.json, figure.svg and paragraph.md."""

from __future__ import annotations

from pathlib import Path

import msgspec

from factorlib.stage import Inputs, Progress
from studies.report.against import against
from studies.steps.conclusion import conclude


class Params(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Nothing to choose."""


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Sum up the scores of all cases."""
    conclude(
        inputs, out, drawn=lambda found: against(found, "seconds", ("entries", "new_light", "diffuse", "roughness"))
    )
