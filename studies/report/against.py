"""A figure of one measure against others: a panel for each, settings as numbered dots, with the 95 % intervals of both; both axes logarithmic."""

from __future__ import annotations

from collections.abc import Sequence

from factorlib.report.plot import log_ticks
from studies.core.table import Conclusion, Row, Spread
from studies.report.heads import with_unit
from studies.svg import COLOURS, LogAxis, dot, line, page, text

WIDTH, HEIGHT, COLUMNS = 380, 290, 2  # of a panel; panels side by side
LEFT, RIGHT, TOP, BOTTOM = 62, 18, 44, 46
HEAD, KEY = 34, 190  # of the title, of the key's column
LEAST = 1e-9


def against(found: Conclusion, across: str, measures: Sequence[str]) -> str:
    """As SVG that stands alone."""
    shown = [m for m in measures if any({m, across} <= row.cells.keys() for row in found.rows)]
    title = f"{found.title}: {len(found.seeds)} seed{'s' * (len(found.seeds) > 1)}" + (
        f" — {found.label}" if found.label else ""
    )
    parts = [text(LEFT / 2, 22, title, css="title")]
    for k, measure in enumerate(shown):
        parts += _panel(found, across, measure, WIDTH * (k % COLUMNS), HEAD + HEIGHT * (k // COLUMNS))
    for k, row in enumerate(found.rows):
        y = HEAD + TOP + 18 * k
        parts += [
            dot(WIDTH * COLUMNS + 16, y, _colour(k)),
            text(WIDTH * COLUMNS + 28, y + 4, f"{k + 1}  {row.label}", css="small"),
        ]
    return page(
        WIDTH * COLUMNS + KEY,
        max(HEAD + HEIGHT * -(-len(shown) // COLUMNS), HEAD + TOP + 18 * len(found.rows) + 10),
        parts,
    )


def _panel(found: Conclusion, across: str, measure: str, x0: float, y0: float) -> list[str]:
    rows = [(k, row) for k, row in enumerate(found.rows) if {across, measure} <= row.cells.keys()]
    right = _axis([row.cells[across].spread for _, row in rows], x0 + LEFT, x0 + WIDTH - RIGHT)
    up = _axis([row.cells[measure].spread for _, row in rows], y0 + HEIGHT - BOTTOM, y0 + TOP)
    parts = [text(x0 + LEFT, y0 + TOP - 14, with_unit(measure), css="small")]
    for value in _ticks(up):
        parts += [
            line(right.start, up(value), right.end, up(value), "grid"),
            text(right.start - 6, up(value) + 4, f"{value:g}", "end", "small soft"),
        ]
    for value in _ticks(right):
        parts += [
            line(right(value), up.start, right(value), up.end, "grid"),
            text(right(value), up.start + 16, f"{value:g}", "middle", "small soft"),
        ]
    parts += [
        line(right.start, up.start, right.end, up.start, "axis"),
        text((right.start + right.end) / 2, up.start + 34, with_unit(across), "middle", "small soft"),
    ]
    return parts + [mark for k, row in rows for mark in _marks(k, row, right, up, across, measure)]


def _marks(k: int, row: Row, right: LogAxis, up: LogAxis, across: str, measure: str) -> list[str]:
    a, b, style = row.cells[across].spread, row.cells[measure].spread, f"stroke: {_colour(k)}; stroke-width: 1.4"
    x, y = right(a.mean), up(max(b.mean, LEAST))
    parts = []
    if a.low is not None and b.low is not None:
        ends = [
            [
                min(max(axis(max(end, LEAST)), min(axis.start, axis.end)), max(axis.start, axis.end))
                for end in (s.low, s.high)
            ]
            for axis, s in ((right, a), (up, b))
        ]
        parts = [line(ends[0][0], y, ends[0][1], y, style=style), line(x, ends[1][0], x, ends[1][1], style=style)]
    return [*parts, dot(x, y, _colour(k)), text(x + 7, y - 5, str(k + 1), css="small")]


def _axis(spreads: Sequence[Spread], start: float, end: float) -> LogAxis:
    """From half the least mean to twice the greatest."""
    means = [max(s.mean, LEAST) for s in spreads]
    return LogAxis(min(means) / 2, max(means) * 2, start, end)


def _ticks(axis: LogAxis) -> list[float]:
    return [10**k for k in log_ticks(axis.log(axis.low), axis.log(axis.high))]


def _colour(k: int) -> str:
    return COLOURS[k % len(COLOURS)]
