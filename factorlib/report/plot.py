"""Line plots as SVG: thin axes, few ticks, colours of the page's own style (classes s0, s1, …)."""

import math
from collections.abc import Callable, Mapping, Sequence

from factorlib.report.template import rendered

WIDTH, HEIGHT, LEFT, RIGHT, TOP, BASE = 560, 240, 58, 540, 12, 200
Line = tuple[Sequence[float], Sequence[float]]  # x and y of its points


def line_plot(
    lines: Mapping[str, Line], x_label: str, y_label: str, log_y: bool = False, rules: Sequence[float] = ()
) -> str:
    """An SVG of lines by name, with points in order of x; empty text if there is nothing to draw.

    A value that is not finite (or not positive, on a logarithmic axis) is left out.
    rules: x of thin vertical rules
    """
    height = math.log10 if log_y else float
    kept = [[(x, height(y)) for x, y in zip(*line, strict=True) if _drawable(y, log_y)] for line in lines.values()]
    points = [point for line in kept for point in line]
    if not points:
        return ""
    xs, ys = zip(*points)
    above = 0.05 * (max(ys) - min(ys)) or 0.5
    across = _scale(min(xs), max(xs), LEFT, RIGHT)
    up = _scale(min(ys) - above, max(ys) + above, BASE, TOP)
    up_ticks = [(up(y), f"{10**y:.3g}") for y in log_ticks(min(ys), max(ys))] if log_y else []
    return rendered(
        "plot.svg", width=WIDTH, height=HEIGHT, left=LEFT, right=RIGHT, top=TOP, base=BASE,
        x_label=x_label, y_label=y_label, rules=[f"{across(x):.1f}" for x in rules],
        up_ticks=up_ticks or [(up(y), f"{y:g}") for y in ticks(min(ys), max(ys))],
        across_ticks=[(f"{across(x):.1f}", f"{x:g}") for x in ticks(min(xs), max(xs), 8)],
        lines=[(k, [(f"{across(x):.1f}", f"{up(y):.1f}") for x, y in line]) for k, line in enumerate(kept) if line],
    )  # fmt: skip


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


def _drawable(value: float, log_y: bool) -> bool:
    return value is not None and math.isfinite(value) and (value > 0 or not log_y)


def _scale(low: float, high: float, start: float, end: float) -> Callable[[float], float]:
    return lambda value: start + (value - low) / ((high - low) or 1.0) * (end - start)
