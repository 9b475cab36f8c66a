"""index.html of the studies that are done: figures, tables, paragraphs, and each conclusion beside the paper's; stands alone."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jinja2
import msgspec

from benchmarks.tools import exact
from studies.core.measures import MEASURES
from studies.core.table import Cell, Conclusion, Picture
from studies.report.heads import with_unit
from studies.report.tables import answer_to_the_paper

TEMPLATES = Path(__file__).parent / "templates"


def page(studies: Sequence[tuple[Any, Path]]) -> str:
    """HTML of studies, each the value of its table.json and the folder of its figure.svg, which is this project's own and set as it is.

    A table that another version of the project wrote in another form is left out, and the page names it.
    """
    read = [(_conclusion(table), folder) for table, folder in studies]
    found = [_shown(conclusion, folder) for conclusion, folder in read if conclusion]
    others = [folder.name for conclusion, folder in read if not conclusion]
    environment = jinja2.Environment(
        autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined
    )
    template = environment.from_string((TEMPLATES / "index.html").read_text(encoding="utf-8"))
    quick = any(conclusion.label for conclusion, _, _ in found)
    return template.render(
        studies=found, others=others, quick=quick, with_unit=with_unit, number=number, answer=answer_to_the_paper
    )


def _conclusion(table: Any) -> Conclusion | None:
    """The table as this version writes it; None where it is of another form, or of a measure that is no longer taken."""
    try:
        found = msgspec.convert(table, Conclusion, str_keys=True)
    except msgspec.ValidationError:
        return None
    return found if set(found.measures) <= MEASURES.keys() else None


def _shown(found: Conclusion, folder: Path) -> tuple[Conclusion, str, list[tuple[Picture, str]]]:
    """A study, its figure, and its pictures as data URLs."""
    data = [base64.b64encode((folder / "pictures" / picture.file).read_bytes()).decode() for picture in found.pictures]
    return found, (folder / "figure.svg").read_text(encoding="utf-8"), list(zip(found.pictures, data, strict=True))


def number(cell: Cell | None) -> str:
    """A mean and the half width of its interval.

    >>> from studies.core.statistics import spread
    >>> number(Cell(spread([0.1, 0.12]), {})), number(Cell(spread([0.1]), {})), number(None)
    ('.11 ± .13', '.1', '–')
    """
    if cell is None:
        return "–"
    mean = exact(cell.spread.mean, 3)
    return mean if cell.spread.high is None else f"{mean} ± {exact(cell.spread.high - cell.spread.mean)}"
