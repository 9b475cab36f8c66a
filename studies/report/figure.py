"""A study's figure: a panel for each measure, settings across, every seed a dot, the mean with its 95 % interval, the null as a line."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from factorlib.report.plot import ticks
from studies.core.table import Cell, Conclusion
from studies.report.heads import with_unit
from studies.svg import COLOURS, SOFT, dot, line, page, path, text

WIDTH, HEIGHT, COLUMNS = 380, 230, 2  # of a panel; panels side by side, one alone where labels need the room
LETTER, TURN = (
    6.0,
    35.0,
)  # pixels of a label's letter; degrees that labels are turned by where they do not fit beside each other
LEFT, RIGHT, TOP, BOTTOM = 58, 14, 44, 50
HEAD = 34  # of the title
FAR = 2.5  # times the highest value
Place = Callable[[float], float]  # where a number stands, pixels


def figure(found: Conclusion) -> str:
    """As SVG that stands alone."""
    shown = [m for m in found.measures if any(m in row.cells for row in found.rows)]
    title = (
        f"{found.title}: {len(found.seeds)} {found.over if len(found.seeds) > 1 else found.over.removesuffix('s')}"
        + (f" — {found.label}" if found.label else "")
    )
    parts = [text(LEFT / 2, 22, title, css="title")]
    columns, height = (1, HEIGHT + turned_height(found)) if crowded(found) else (COLUMNS, HEIGHT)
    for k, measure in enumerate(shown):
        parts += _panel(found, measure, WIDTH * (k % columns), HEAD + height * (k // columns))
    return page(WIDTH * COLUMNS, HEAD + height * -(-len(shown) // columns), parts)


def crowded(found: Conclusion) -> bool:
    """Whether the settings' labels do not fit beside each other into one of two panels."""
    return LETTER * (max(len(row.label) for row in found.rows) + 1) * len(found.rows) > WIDTH - LEFT - RIGHT


def turned_height(found: Conclusion) -> float:
    """What turned labels need below a panel, pixels."""
    return LETTER * max(len(row.label) for row in found.rows) * math.sin(math.radians(TURN))


def _panel(found: Conclusion, measure: str, x0: float, y0: float) -> list[str]:
    cells = [(k, row.cells[measure]) for k, row in enumerate(found.rows) if measure in row.cells]
    found_top = max(v for _, cell in cells for v in (*cell.values.values(), cell.spread.high or 0.0)) or 1.0
    null = max((cell.null for _, cell in cells if cell.null is not None), default=0.0)
    near = null <= FAR * found_top  # a far one would press all else to the axis: it is written instead
    top = max(found_top, null) if near else found_top
    turned, width = (TURN, WIDTH * COLUMNS) if crowded(found) else (0.0, WIDTH)
    below = 36 + (turned_height(found) if turned else 0.0)
    left, right, base, high = x0 + LEFT, x0 + width - RIGHT, y0 + HEIGHT - BOTTOM, y0 + TOP

    def across(k: float) -> float:
        """Of setting k."""
        return left + (k + 0.5) / len(found.rows) * (right - left)

    def up(value: float) -> float:
        """Of a value; the axis begins at 0."""
        return base - max(value, 0.0) / (1.05 * top) * (base - high)

    parts = [text(left, high - 14, with_unit(measure), css="small")]
    for value in ticks(0, 1.05 * top, 4):
        parts += [
            line(left, up(value), right, up(value), "grid"),
            text(left - 6, up(value) + 4, f"{value:g}", "end", "small soft"),
        ]
    parts += [
        line(left, base, right, base, "axis"),
        text((left + right) / 2, base + below, found.varied, "middle", "small soft"),
    ]
    anchor = "end" if turned else "middle"
    parts += [text(across(k), base + 16, row.label, anchor, "small", -turned) for k, row in enumerate(found.rows)]
    parts += [] if near else [text(right, high - 2, f"a guess: up to {null:.2g}", "end", "small soft")]
    return parts + _marks(cells, across, up, near)


def _marks(cells: Sequence[tuple[int, Cell]], across: Place, up: Place, with_null: bool) -> list[str]:
    null = [(across(k), up(cell.null)) for k, cell in cells if with_null and cell.null is not None]
    parts = [path(null, SOFT, dashed=True)] if len(null) > 1 else []
    for k, cell in cells:
        if cell.spread.low is not None:
            parts.append(
                line(
                    across(k),
                    up(cell.spread.low),
                    across(k),
                    up(cell.spread.high),
                    style=f"stroke: {COLOURS[0]}; stroke-width: 1.8",
                )
            )
            parts += [dot(across(k) + 7, up(value), COLOURS[1], radius=1.6) for value in cell.values.values()]
        parts.append(dot(across(k), up(cell.spread.mean), COLOURS[0], hollow=cell.spread.low is None, radius=3.6))
    return parts
