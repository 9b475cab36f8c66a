"""What a study comes to: table.csv, table.json, figure.svg, paragraph.md, and pictures where its kind has any."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import msgspec

from factorlib.jsonfile import read_json, write_json
from factorlib.stage import Inputs
from factorlib.wholefile import write_bytes, write_text
from studies.catalogue.contents import STUDIES
from studies.core.case import Score
from studies.core.study import Scale
from studies.core.table import Conclusion, Picture
from studies.report.conclusion import concluded
from studies.report.figure import figure
from studies.report.tables import csv_text, paragraph


def nothing(found: Conclusion) -> list[str]:
    """No notes."""
    return []


def by_claims(found: Conclusion) -> str:
    """The answer to the paper is that of the claims."""
    return ""


def conclude(
    inputs: Inputs,
    out: Path,
    pictures: Mapping[Picture, bytes] | None = None,
    notes: Callable[[Conclusion], list[str]] = nothing,
    answer: Callable[[Conclusion], str] = by_claims,
    drawn: Callable[[Conclusion], str] = figure,
) -> None:
    """Sum up the scores of all cases.

    pictures: PNG files, in the order in which the page shows them
    notes:    sentences that are no claims, of what was summed up
    answer:   to the paper, where no claim can give it
    drawn:    the figure, where a study's is not a panel for each measure
    """
    facts = inputs.facts["dataset.study"]
    study, scale = STUDIES[facts["name"]], msgspec.convert(facts["scale"], Scale)
    scores = msgspec.convert(read_json(inputs["score"] / "scores.json"), dict[str, Score])
    summed = concluded(study, scale, scores)
    found = msgspec.structs.replace(summed, pictures=list(pictures or {}), notes=notes(summed), answer=answer(summed))
    write_json(out / "table.json", found)
    write_text(out / "table.csv", csv_text(found))
    write_text(out / "figure.svg", drawn(found))
    write_text(out / "paragraph.md", paragraph(found))
    for picture, data in (pictures or {}).items():
        (out / "pictures").mkdir(exist_ok=True)
        write_bytes(out / "pictures" / picture.file, data)
