"""Figures as SVG that stands alone: a line for each setting, a column with an axis of its own for each measure."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from html import escape

import msgspec

from studies.conclusion import Conclusion, head

LEFT, WIDTH, GAP, LINE, TOP, FOOT, COLUMNS = 280, 220, 26, 18, 40, 34, 3  # pixels; columns side by side
LEAST, WIDE, FAR = 1e-9, 20, 2.5  # taken for 0; range that takes a logarithm; times the highest value
COLOURS = ("#c2562b", "#2b5c9e", "#3f8f5b", "#8a4f9e", "#8b6d1f", "#5b6068")
STYLE = """text { font: 11px system-ui, 'DejaVu Sans', sans-serif; fill: #1b1d21; } .soft { fill: #5b6068; }
.title { font-weight: 600; font-size: 13px; } line { stroke: #5b6068; } .grid { stroke: #d9dce1; stroke-width: .7; }"""


class Mark(msgspec.Struct, frozen=True):
    """What stands in a line of a column: the mean, the ends of its interval, single values, and what a guess scores."""

    mean: float
    low: float | None = None
    high: float | None = None
    values: Sequence[float] = ()
    null: float | None = None


def figure(table: Conclusion) -> str:
    """The mean of every measure, its 95 % interval, all seeds as dots and a guess as a dashed line."""
    count, columns = len(table.seeds), {}
    for m in table.measures:
        cells = {k: row.cells[m] for k, row in enumerate(table.rows) if m in row.cells}
        marks = {k: Mark(c.spread.mean, c.spread.low, c.spread.high, [*c.values.values()], c.null) for k, c in cells.items()}  # fmt: skip
        columns |= {head(m): marks} if marks else {}
    title = f"{table.title}: {count} {table.over if count > 1 else table.over.removesuffix('s')}"
    title += f" — {table.quick}" if table.quick else ""
    return drawn(title, [row.label for row in table.rows], columns, table.varied)


def drawn(
    title: str, labels: Sequence[str], columns: Mapping[str, Mapping[int, Mark]], foot: str = "", form: str = "{:g}"
) -> str:
    """The figure; columns: marks by the number of their line, by head;  form: how an axis writes a value."""
    parts, height = [_text(20, 22, title, css="title")], LINE * len(labels) + 6
    for k, (words, marks) in enumerate(columns.items()):
        top = 30 + TOP + (k // COLUMNS) * (height + TOP + FOOT)
        if k % COLUMNS == 0:
            parts += [_text(LEFT - 8, top + LINE * (n + 0.75), of, "end") for n, of in enumerate(labels)]
        parts += _column(
            words, marks, LEFT + (WIDTH + GAP) * (k % COLUMNS), top, height, COLOURS[k % len(COLOURS)], form
        )
    bottom = 30 + -(-len(columns) // COLUMNS) * (height + TOP + FOOT)
    size = f"{LEFT + (WIDTH + GAP) * min(COLUMNS, len(columns)):g} {bottom:g}"
    start = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {size}">\n<style>{STYLE}</style>\n'
    page = [
        start + '<rect width="100%" height="100%" fill="#ffffff"/>',
        *parts,
        _text(20, bottom - 6, foot, css="soft"),
    ]
    return "\n".join([*page, "</svg>\n"])


def _column(
    words: str, marks: Mapping[int, Mark], left: float, top: float, height: float, colour: str, form: str
) -> list[str]:
    values = [v for m in marks.values() for v in (m.mean, *m.values, *((m.high,) if m.high is not None else ()))]
    null = max((m.null for m in marks.values() if m.null is not None), default=0.0)
    near = null <= FAR * max(values)  # a far one would press all else to the axis: it is written instead
    values += [m.null for m in marks.values() if near and m.null is not None]
    low, high = max(min(values), LEAST), max(*values, LEAST)
    log = min(values) > LEAST and high > WIDE * low
    scale, ends = (math.log10, (low / 1.6, 1.6 * high)) if log else (float, (0.0, 1.05 * high))
    first, last = map(scale, ends)
    shown = [10**t for t in log_ticks(first, last)] if log else ticks(first, last, 4)

    def x(value: float) -> float:
        """The pixel of a value, that of the nearer end for one beyond."""
        return left + WIDTH * min(max((scale(max(value, ends[0])) - first) / (last - first), 0.0), 1.0)

    parts = [_text(left, top - 8, words + ("" if near else f"; a guess: up to {null:.2g}"))]
    parts += [_line(left, left + WIDTH, top + height, top + height)]
    for value in shown:
        parts += [_line(x(value), x(value), top, top + height, 'class="grid"')]
        parts += [_text(x(value), top + height + 15, form.format(value), "middle", "soft")]
    for k, m in marks.items():
        y = top + LINE * (k + 0.55)
        if m.low is not None and m.high is not None:
            parts += [_line(x(m.low), x(m.high), y, y, f'style="stroke: {colour}; stroke-width: 1.8"')]
        parts += [_dot(x(v), y + 5, "#5b6068", "#5b6068", 1) for v in m.values if len(m.values) > 1]
        if near and m.null is not None:
            parts += [_line(x(m.null), x(m.null), y - 6, y + 6, 'stroke-dasharray="2 2"')]
        parts += [_dot(x(m.mean), y, colour, "#ffffff" if m.low is None else colour, 3.2)]
    return parts


def _text(x: float, y: float, words: str, anchor: str = "start", css: str = "") -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" class="{css}">{escape(words)}</text>'


def _line(x1: float, x2: float, y1: float, y2: float, style: str = "") -> str:
    return f'<line x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}" {style}/>'


def _dot(x: float, y: float, colour: str, fill: str, radius: float) -> str:
    return f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{radius:g}" fill="{fill}" stroke="{colour}" stroke-width="1.8"/>'


def ticks(low: float, high: float, most: int = 5) -> list[float]:
    """Round values from `low` to `high`.

    >>> ticks(0, 9.3)
    [0.0, 2.0, 4.0, 6.0, 8.0]
    """
    span = high - low or 1.0
    unit = 10 ** math.floor(math.log10(span / most))
    step = next(unit * k for k in (1, 2, 5, 10) if span / (unit * k) <= most)
    first = math.ceil(low / step - 1e-9)
    return [round(k * step, 12) + 0.0 for k in range(first, math.floor(high / step + 1e-9) + 1)]


def log_ticks(low: float, high: float) -> list[float]:
    """Logarithms of round values between 10^low and 10^high: decades, and 2 and 5 where these
    are few, or what a linear axis would have.

    >>> [round(10**t, 3) for t in log_ticks(-1.2, 0.1)]
    [0.1, 0.2, 0.5, 1.0]
    """
    mantissas = (1, 2, 5) if high - low < 2.5 else (1,)
    every = [k + math.log10(m) for k in range(math.floor(low), math.ceil(high) + 1) for m in mantissas]
    inside = [t for t in every if low - 1e-9 <= t <= high + 1e-9]
    if len(inside) < 2:
        return [math.log10(t) for t in ticks(10**low, 10**high, 4)]
    return inside[:: max(1, -(-len(inside) // 8))]
