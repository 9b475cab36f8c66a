"""What a study comes to: table.csv, table.json, figure.svg, paragraph.md, and pictures where its kind has any."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import msgspec

from factorlib.jsonfile import read_json, write_json
from factorlib.stage import Inputs
from factorlib.wholefile import write_bytes, write_text
from studies.catalogue.contents import STUDIES
from studies.core.case import Score
from studies.core.study import Scale
from studies.core.table import Picture
from studies.report.conclusion import concluded
from studies.report.figure import figure
from studies.report.tables import csv_text, paragraph


def conclude(inputs: Inputs, out: Path, pictures: Mapping[Picture, bytes] | None = None) -> None:
    """Sum up the scores of all cases.  pictures: PNG files, in the order in which the page shows them."""
    facts = inputs.facts["dataset.study"]
    study, scale = STUDIES[facts["name"]], msgspec.convert(facts["scale"], Scale)
    scores = msgspec.convert(read_json(inputs["score"] / "scores.json"), dict[str, Score])
    found = msgspec.structs.replace(concluded(study, scale, scores), pictures=list(pictures or {}))
    write_json(out / "table.json", found)
    write_text(out / "table.csv", csv_text(found))
    write_text(out / "figure.svg", figure(found))
    write_text(out / "paragraph.md", paragraph(found))
    for picture, data in (pictures or {}).items():
        (out / "pictures").mkdir(exist_ok=True)
        write_bytes(out / "pictures" / picture.file, data)
