"""A figure of many settings: a line for each, a column for each measure with the range of all seeds and their mean; 0 stands at the left end."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

from factorlib.report.plot import log_ticks
from studies.core.table import Conclusion, Row
from studies.report.heads import with_unit
from studies.svg import COLOURS, LogAxis, dot, line, page, text

LABEL, WIDTH, GAP, LINE, HEAD, FOOT = (
    270,
    210,
    24,
    17,
    36,
    40,
)  # of the labels, of a column's axis and between; of a setting; above and below
LETTER = 5.6  # of a column's head, pixels
LEAST = 1e-9  # taken for 0


def bars(found: Conclusion) -> str:
    """As SVG that stands alone; settings whose labels begin alike, up to a colon, share columns: the measures that they have.  So do those without a colon."""
    title = f"{found.title}: {len(found.seeds)} seed{'s' * (len(found.seeds) > 1)}" + (
        f" — {found.label}" if found.label else ""
    )
    parts, top, end = [text(20, 22, title, css="title")], 30.0, 0.0
    for name in dict.fromkeys(_group(row) for row in found.rows):
        rows = [row for row in found.rows if _group(row) == name]
        shown = [m for m in found.measures if any(m in row.cells for row in rows)]
        lefts = _columns(shown)
        parts += _block(rows, shown, lefts, top)
        top, end = top + HEAD + LINE * len(rows) + FOOT, max(end, lefts[-1])
    return page(end, top, parts)


def _group(row: Row) -> str:
    name, colon, _ = row.label.partition(": ")
    return name if colon else ""


def _columns(measures: Sequence[str]) -> list[float]:
    """Where each column begins, and where the last one ends: as wide as its axis and its head need."""
    return list(itertools.accumulate((max(WIDTH, LETTER * len(with_unit(m))) + GAP for m in measures), initial=LABEL))


def _block(rows: Sequence[Row], measures: Sequence[str], lefts: Sequence[float], top: float) -> list[str]:
    labels = [text(LABEL - 8, top + HEAD + LINE * (k + 0.75), row.label, "end", "small") for k, row in enumerate(rows)]
    columns = [_column(rows, m, lefts[k], top + HEAD, COLOURS[k % len(COLOURS)]) for k, m in enumerate(measures)]
    return [*labels, *(part for column in columns for part in column)]


def _column(rows: Sequence[Row], measure: str, left: float, top: float, colour: str) -> list[str]:
    cells = [(k, row.cells[measure]) for k, row in enumerate(rows) if measure in row.cells]
    bottom = top + LINE * len(rows) + 6
    parts = [text(left, top - 10, with_unit(measure), css="small"), line(left, bottom, left + WIDTH, bottom, "axis")]
    positive = [v for _, cell in cells for v in cell.values.values() if v > LEAST]
    if not positive:
        return [*parts, text(left, bottom + 15, "0 everywhere", css="small soft")]
    across = LogAxis(min(positive) / 2, max(positive) * 2, left, left + WIDTH)
    for value in (10**t for t in log_ticks(across.log(across.low), across.log(across.high))):
        parts += [
            line(across(value), top, across(value), bottom, "grid"),
            text(across(value), bottom + 15, f"{value:g}", "middle", "small soft"),
        ]
    for k, cell in cells:
        y, ends = (
            top + LINE * (k + 0.55),
            [across(max(v, across.low)) for v in (min(cell.values.values()), max(cell.values.values()))],
        )
        parts += [
            line(ends[0], y, ends[1], y, style=f"stroke: {colour}; stroke-width: 2"),
            dot(across(max(cell.spread.mean, across.low)), y, colour, radius=3),
        ]
    return parts
