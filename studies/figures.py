"""Figures of studies, as SVG that stands alone: a row for each setting, or one measure against others."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import msgspec

from factorlib.report.plot import log_ticks, ticks
from studies.conclusion import MEASURES, Conclusion, Row
from studies.svg import COLOURS, SOFT, LogAxis, dot, line, page, text

LABEL, WIDTH, GAP, LINE, HEAD, FOOT, COLUMNS = 280, 220, 26, 18, 40, 34, 3  # of rows, pixels; columns side by side
PANEL, HEIGHT, LEFT, RIGHT, TOP, BOTTOM, KEY = 380, 290, 62, 18, 44, 46, 190  # of one measure against another
LEAST, WIDE, FAR = 1e-9, 20, 2.5  # taken for 0; range that takes a logarithm; times the highest value


class Mark(msgspec.Struct, frozen=True):
    """What stands in a row of a column: the mean, the ends of its interval, single values, and what a guess scores."""

    mean: float
    low: float | None = None
    high: float | None = None
    values: Sequence[float] = ()
    null: float | None = None


class Axis:
    """Where values stand between two pixels, from 0 or, over a wide range of positive values, by their logarithm."""

    def __init__(self, values: Sequence[float], start: float, end: float, log: bool | None = None):
        low, high = min(values), max(*values, LEAST)
        log = low > LEAST and high > WIDE * low if log is None else log
        self.start, self.end = start, end
        if log:
            place = LogAxis(max(low, LEAST) / 1.6, 1.6 * high, start, end)
            self._place, self.ticks = place, [10**t for t in log_ticks(math.log10(place.low), math.log10(place.high))]
        else:
            self._place = lambda value: start + max(value, 0.0) / (1.05 * high) * (end - start)
            self.ticks = ticks(0, 1.05 * high, 4)

    def __call__(self, value: float) -> float:
        """The pixel of a value, that of the nearer end for one beyond."""
        return min(max(self._place(value), min(self.start, self.end)), max(self.start, self.end))


def rows_of_marks(
    title: str,
    labels: Sequence[str],
    columns: dict[str, dict[int, Mark]],
    top: float = 30,
    words: Callable = "{:g}".format,
) -> tuple[list[str], float, float]:
    """The parts of a figure with a line for each label, a column for each head, and its marks by line; its width, and where it ends.

    words: how an axis writes a value
    """
    parts, heads = [text(20, 22, title, css="title")] if title else [], list(columns)
    for first in range(0, len(heads), COLUMNS):
        parts += [
            text(LABEL - 8, top + HEAD + LINE * (k + 0.75), label, "end", "small") for k, label in enumerate(labels)
        ]
        for k, head in enumerate(heads[first : first + COLUMNS]):
            left, colour = LABEL + (WIDTH + GAP) * k, COLOURS[(first + k) % len(COLOURS)]
            parts += _column(head, columns[head], left, top + HEAD, LINE * len(labels) + 6, colour, words)
        top += HEAD + LINE * len(labels) + FOOT
    return parts, LABEL + (WIDTH + GAP) * min(COLUMNS, len(heads)), top


def _column(
    head: str, marks: dict[int, Mark], left: float, top: float, height: float, colour: str, words: Callable
) -> list[str]:
    values = [v for m in marks.values() for v in (m.mean, *m.values, *((m.high,) if m.high is not None else ()))]
    null = max((m.null for m in marks.values() if m.null is not None), default=0.0)
    near = null <= FAR * max(values)  # a far one would press all else to the axis: it is written instead
    nulls = [m.null for m in marks.values() if near and m.null is not None]
    axis, bottom = Axis([*values, *nulls], left, left + WIDTH), top + height
    above = "" if near else f"; a guess: up to {null:.2g}"
    parts = [text(left, top - 8, head + above, css="small"), line(left, bottom, left + WIDTH, bottom, "axis")]
    for value in axis.ticks:
        parts += [line(axis(value), top, axis(value), bottom, "grid")]
        parts += [text(axis(value), bottom + 15, words(value), "middle", "small soft")]
    for k, m in marks.items():
        y = top + LINE * (k + 0.55)
        if m.low is not None:
            parts += [line(axis(m.low), y, axis(m.high), y, style=f"stroke: {colour}; stroke-width: 1.8")]
        parts += [dot(axis(v), y + 5, SOFT, radius=1) for v in m.values if len(m.values) > 1]
        if near and m.null is not None:
            parts += [line(axis(m.null), y - 6, axis(m.null), y + 6, style=f"stroke: {SOFT}; stroke-dasharray: 2 2")]
        parts += [dot(axis(m.mean), y, colour, hollow=m.low is None, radius=3.2)]
    return parts


def figure(table: Conclusion, across: str = "") -> str:
    """A line for each setting with the mean of every measure, its 95 % interval, all seeds as dots and a guess as a dashed line.

    Settings whose labels begin alike, up to a colon, share axes: those of the measures that they have.

    across: the measure that stands across in panels of the others, instead
    """
    count = len(table.seeds)
    title = f"{table.title}: {count} {table.over if count > 1 else table.over.removesuffix('s')}"
    title += f" — {table.label}" if table.label else ""
    if across:
        return _against(table, title, across)
    parts, width, top = [], 0.0, 30.0
    for kind in dict.fromkeys(_kind(row) for row in table.rows):
        rows = [row for row in table.rows if _kind(row) == kind]
        columns = {MEASURES[m].head: _marks(rows, m) for m in table.measures if any(m in row.cells for row in rows)}
        more, wide, top = rows_of_marks("" if parts else title, [row.label for row in rows], columns, top)
        parts, width = parts + more, max(width, wide)
    return page(width, top, [*parts, text(20, top - 6, table.varied, css="small soft")])


def _kind(row: Row) -> str:
    kind, colon, _ = row.label.partition(": ")
    return kind if colon else ""


def _marks(rows: Sequence[Row], measure: str) -> dict[int, Mark]:
    cells = {k: row.cells[measure] for k, row in enumerate(rows) if measure in row.cells}
    return {
        k: Mark(c.spread.mean, c.spread.low, c.spread.high, list(c.values.values()), c.null) for k, c in cells.items()
    }


def _against(table: Conclusion, title: str, across: str) -> str:
    """Panels of one measure each, settings as numbered dots, with the 95 % intervals of both; both axes logarithmic."""
    parts, measures = [text(20, 22, title, css="title")], [m for m in table.measures if m != across]
    measures = [m for m in measures if any({m, across} <= row.cells.keys() for row in table.rows)]
    for k, row in enumerate(table.rows):
        y = HEAD + TOP + LINE * k
        label = text(2 * PANEL + 28, y + 4, f"{k + 1}  {row.label}", css="small")
        parts += [dot(2 * PANEL + 16, y, COLOURS[k % len(COLOURS)]), label]
    for n, measure in enumerate(measures):
        x0, y0 = PANEL * (n % 2), HEAD + HEIGHT * (n // 2)
        spreads = {
            k: (row.cells[across].spread, row.cells[measure].spread)
            for k, row in enumerate(table.rows)
            if {across, measure} <= row.cells.keys()
        }
        right = Axis([a.mean for a, _ in spreads.values()], x0 + LEFT, x0 + PANEL - RIGHT, log=True)
        up = Axis([b.mean for _, b in spreads.values()], y0 + HEIGHT - BOTTOM, y0 + TOP, log=True)
        parts += [text(x0 + LEFT, y0 + TOP - 14, MEASURES[measure].head, css="small")]
        for v in up.ticks:
            parts += [line(right.start, up(v), right.end, up(v), "grid")]
            parts += [text(right.start - 6, up(v) + 4, f"{v:g}", "end", "small soft")]
        for v in right.ticks:
            parts += [line(right(v), up.start, right(v), up.end, "grid")]
            parts += [text(right(v), up.start + 16, f"{v:g}", "middle", "small soft")]
        middle = (right.start + right.end) / 2
        parts += [text(middle, up.start + 34, MEASURES[across].head, "middle", "small soft")]
        for k, (a, b) in spreads.items():
            x, y, colour = right(a.mean), up(b.mean), COLOURS[k % len(COLOURS)]
            if a.low is not None and b.low is not None:
                style = f"stroke: {colour}; stroke-width: 1.4"
                parts += [line(right(max(a.low, LEAST)), y, right(a.high), y, style=style)]
                parts += [line(x, up(max(b.low, LEAST)), x, up(b.high), style=style)]
            parts += [dot(x, y, colour), text(x + 7, y - 5, str(k + 1), css="small")]
    rows = max(HEIGHT * -(-len(measures) // 2), TOP + LINE * len(table.rows) + 10)
    return page(2 * PANEL + KEY, HEAD + rows, parts)
