"""A figure of many settings: a line for each, a column for each measure with the range of all seeds and their mean."""

from __future__ import annotations

from benchmarks.figure import COLOURS, LogAxis, dot, line, page, text
from factorlib.report.plot import log_ticks
from studies.core.measures import MEASURES
from studies.core.table import Conclusion

LABEL, WIDTH, GAP, LINE, HEAD = 270, 230, 24, 17, 62  # of the labels, of a column and between; of a setting; of the title
LEAST = 1e-9  # what stands at the left end of an axis, and 0 too


def bars(found: Conclusion) -> str:
    """As SVG that stands alone; a column for each measure that some setting has, values on logarithmic axes."""
    shown = [m for m in found.measures if any(m in row.cells for row in found.rows)]
    title = f"{found.title}: {len(found.seeds)} seed{'s' * (len(found.seeds) > 1)}" + (f" — {found.label}" if found.label else "")
    bottom = HEAD + LINE * len(found.rows) + 8
    parts = [text(20, 22, title, css="title")]
    parts += [text(LABEL - 8, HEAD + LINE * (k + 0.75), row.label, "end", "small") for k, row in enumerate(found.rows)]
    for column, measure in enumerate(shown):
        parts += _column(found, measure, LABEL + column * (WIDTH + GAP), bottom, COLOURS[column % len(COLOURS)])
    return page(LABEL + len(shown) * (WIDTH + GAP), bottom + 26, parts)


def _column(found: Conclusion, measure: str, left: float, bottom: float, colour: str) -> list[str]:
    cells = [(k, row.cells[measure]) for k, row in enumerate(found.rows) if measure in row.cells]
    positive = [v for _, cell in cells for v in cell.values.values() if v > LEAST] or [1.0]
    across = LogAxis(min(positive) / 2, max(positive) * 2, left, left + WIDTH)
    parts = [text(left, HEAD - 12, MEASURES[measure].label, css="small"), line(left, bottom, left + WIDTH, bottom, "axis")]
    for value in (10**t for t in log_ticks(across.log(across.low), across.log(across.high))):
        parts += [line(across(value), HEAD, across(value), bottom, "grid"), text(across(value), bottom + 15, f"{value:g}", "middle", "small soft")]
    for k, cell in cells:
        y, ends = HEAD + LINE * (k + 0.55), [across(max(v, across.low)) for v in (min(cell.values.values()), max(cell.values.values()))]
        parts += [line(ends[0], y, ends[1], y, style=f"stroke: {colour}; stroke-width: 2"), dot(across(max(cell.spread.mean, across.low)), y, colour, radius=3)]
    return parts
