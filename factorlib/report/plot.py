"""Line plots as SVG: thin axes, few ticks, colours of the page's own style (classes s0, s1, …)."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from html import escape

import msgspec

WIDTH, HEIGHT = 560, 240
LEFT, RIGHT, TOP, BOTTOM = 58, 20, 12, 40
Scale = Callable[[float], float]  # from a value to its place in the picture, pixels


class Series(msgspec.Struct, frozen=True):
    """Points in order of x; a value that is not finite (or not positive, on a log axis) breaks the line."""

    name: str
    x: Sequence[float]
    y: Sequence[float]


def line_plot(
    series: Sequence[Series],
    x_label: str,
    y_label: str,
    *,
    log_y: bool = False,
    steps: Sequence[float] = (),
    names: Sequence[str] = (),
) -> str:
    """An SVG of the series; empty text if there is nothing to draw.

    steps: x of thin vertical rules;  names: what stands at x = 0, 1, … in place of numbers
    """
    kept = [[(x, y) for x, y in zip(s.x, s.y, strict=True) if _drawable(y, log_y)] for s in series]
    points = [p for line in kept for p in line]
    if not points:
        return ""
    xs, ys = [p[0] for p in points], [math.log10(p[1]) if log_y else p[1] for p in points]
    aside = 0.4 if names else 0.0
    across, up = (
        _scale(min(xs) - aside, max(xs) + aside, LEFT, WIDTH - RIGHT),
        _scale(*_padded(min(ys), max(ys)), HEIGHT - BOTTOM, TOP),
    )
    parts = [
        f'<line class="rule" x1="{across(x):.1f}" x2="{across(x):.1f}" y1="{TOP}" y2="{HEIGHT - BOTTOM}"/>'
        for x in steps
    ]
    parts += _y_axis(up, min(ys), max(ys), log_y) + _x_axis(across, min(xs), max(xs), names)
    parts += [_polyline(line, k, across, up, log_y) for k, line in enumerate(kept) if line]
    labels = (
        f'<text class="label" x="{(LEFT + WIDTH - RIGHT) / 2:.0f}" y="{HEIGHT - 4}" text-anchor="middle">{escape(x_label)}</text>'
        f'<text class="label" transform="translate(12 {(TOP + HEIGHT - BOTTOM) / 2:.0f}) rotate(-90)" text-anchor="middle">'
        f"{escape(y_label)}</text>"
    )
    return f'<svg class="plot" viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{escape(y_label)}">{"".join(parts)}{labels}</svg>'


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


def _padded(low: float, high: float) -> tuple[float, float]:
    extra = 0.05 * (high - low) or 0.5
    return low - extra, high + extra


def _scale(low: float, high: float, start: float, end: float) -> Scale:
    return lambda value: start + (value - low) / ((high - low) or 1.0) * (end - start)


def _y_axis(up: Scale, low: float, high: float, log_y: bool) -> list[str]:
    found = []
    for value in log_ticks(low, high) if log_y else ticks(low, high):
        y, text = up(value), f"{10**value:.3g}" if log_y else f"{value:g}"
        found.append(f'<line class="grid" x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{y:.1f}" y2="{y:.1f}"/>')
        found.append(f'<text x="{LEFT - 6}" y="{y + 3.5:.1f}" text-anchor="end">{text}</text>')
    return found


def _x_axis(across: Scale, low: float, high: float, names: Sequence[str]) -> list[str]:
    base = HEIGHT - BOTTOM
    marks = list(enumerate(names)) if names else [(v, f"{v:g}") for v in ticks(low, high, 8)]
    found = [f'<line class="axis" x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{base}" y2="{base}"/>']
    return found + [
        f'<text x="{across(v):.1f}" y="{base + 14}" text-anchor="middle">{escape(text)}</text>' for v, text in marks
    ]


def _polyline(line: list[tuple[float, float]], k: int, across: Scale, up: Scale, log_y: bool) -> str:
    at = " ".join(f"{across(x):.1f},{up(math.log10(y) if log_y else y):.1f}" for x, y in line)
    dots = (
        "".join(f'<circle cx="{a.split(",")[0]}" cy="{a.split(",")[1]}" r="2.2"/>' for a in at.split())
        if len(line) <= 40
        else ""
    )
    return f'<g class="s{k}"><polyline points="{at}"/>{dots}</g>'
