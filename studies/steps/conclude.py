"""What a study comes to: writes table.csv, table.json, figure.svg and paragraph.md."""

from __future__ import annotations

from pathlib import Path

import msgspec

from factorlib.jsonfile import read_json, write_json
from factorlib.stage import Inputs, Progress
from factorlib.wholefile import write_text
from studies.catalogue import STUDIES
from studies.core.case import Score
from studies.core.study import Scale
from studies.report.conclusion import concluded
from studies.report.figure import figure
from studies.report.tables import csv_text, paragraph


class Params(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Nothing to choose."""


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Sum up the scores of all cases."""
    facts = inputs.facts["dataset.study"]
    study, scale = STUDIES[facts["name"]], msgspec.convert(facts["scale"], Scale)
    scores = msgspec.convert(read_json(inputs["score"] / "scores.json"), dict[str, Score])
    found = concluded(study, scale, scores)
    write_json(out / "table.json", found)
    write_text(out / "table.csv", csv_text(found))
    write_text(out / "figure.svg", figure(found))
    write_text(out / "paragraph.md", paragraph(found))
