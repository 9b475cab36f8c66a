"""A figure of curves: a panel for each measure, a line for each word before the comma of the settings' labels, what follows it across."""

from __future__ import annotations

from factorlib.report.plot import log_ticks
from studies.core.table import Cell, Conclusion
from studies.report.heads import with_unit
from studies.svg import COLOURS, LogAxis, dot, line, page, path, text

WIDTH, HEIGHT, COLUMNS = 380, 250, 2  # of a panel; panels side by side
LEFT, RIGHT, TOP, BOTTOM = 66, 14, 40, 50
HEAD = 56  # of title and key
LEAST = 1e-12
Curves = dict[str, dict[str, Cell]]


def curves(found: Conclusion) -> str:
    """As SVG that stands alone; values on a logarithmic axis."""
    names = list(dict.fromkeys(_split(row.label)[0] for row in found.rows))
    title = f"{found.title}: {len(found.seeds)} seed{'s' * (len(found.seeds) > 1)}" + (
        f" — {found.label}" if found.label else ""
    )
    parts = [text(LEFT / 2, 22, title, css="title")]
    parts += [
        part
        for k, name in enumerate(names)
        for part in (dot(LEFT + 120 * k, 40, COLOURS[k]), text(LEFT + 10 + 120 * k, 44, name))
    ]
    for k, measure in enumerate(found.measures):
        of = {
            name: {_split(row.label)[1]: row.cells[measure] for row in found.rows if _split(row.label)[0] == name}
            for name in names
        }
        parts += _panel(found, of, measure, WIDTH * (k % COLUMNS), HEAD + HEIGHT * (k // COLUMNS))
    return page(WIDTH * COLUMNS, HEAD + HEIGHT * -(-len(found.measures) // COLUMNS), parts)


def _split(label: str) -> tuple[str, str]:
    name, _, place = label.partition(", ")
    return name, place


def _panel(found: Conclusion, of: Curves, measure: str, x0: float, y0: float) -> list[str]:
    places = list(dict.fromkeys(place for cells in of.values() for place in cells))
    means = [max(cell.spread.mean, LEAST) for cells in of.values() for cell in cells.values()]
    left, right, base = x0 + LEFT, x0 + WIDTH - RIGHT, y0 + HEIGHT - BOTTOM
    up = LogAxis(min(means) / 1.6, max(means) * 1.6, base, y0 + TOP)
    across = {place: left + (k + 0.5) / len(places) * (right - left) for k, place in enumerate(places)}
    parts = [text(left, y0 + TOP - 12, with_unit(measure), css="small")]
    for value in (10**t for t in log_ticks(up.log(up.low), up.log(up.high))):
        parts += [
            line(left, up(value), right, up(value), "grid"),
            text(left - 6, up(value) + 4, f"{value:g}", "end", "small soft"),
        ]
    parts += [text(x, base + 16, place, "middle", "small") for place, x in across.items()]
    parts += [
        line(left, base, right, base, "axis"),
        text((left + right) / 2, base + 34, found.varied, "middle", "small soft"),
    ]
    return parts + [part for k, cells in enumerate(of.values()) for part in _curve(cells, across, up, COLOURS[k])]


def _curve(cells: dict[str, Cell], across: dict[str, float], up: LogAxis, colour: str) -> list[str]:
    at = [(across[place], cell.spread) for place, cell in cells.items()]
    bars = [
        line(
            x,
            min(up(max(s.low, up.low)), up.start),
            x,
            max(up(s.high), up.end),
            style=f"stroke: {colour}; stroke-width: 1.2",
        )
        for x, s in at
        if s.low is not None
    ]
    points = [(x, up(max(s.mean, LEAST))) for x, s in at]
    return [path(points, colour), *bars, *(dot(x, y, colour, radius=3.2) for x, y in points)]
