"""The figure: a row for each graph and verb, a dot for each program, on a logarithmic axis of seconds."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import median
from typing import Any

from benchmarks.figure import COLOURS, LogAxis, dot, line, page, text

NAMES = {"factorlib": "factorlib", "dvc": "DVC", "snakemake": "Snakemake"}
WIDTH, LEFT, ROW, TOP = 720.0, 210.0, 30.0, 64.0


def picture(timings: Sequence[Any]) -> str:
    """Medians as dots, over a line from the fastest to the slowest round."""
    rows = list(dict.fromkeys((one.photos, one.verb) for one in timings))
    seconds = [value for one in timings for value in one.wall]
    axis = LogAxis(min(seconds) / 1.5, max(seconds) * 1.5, LEFT, WIDTH - 20)
    bottom = TOP + ROW * len(rows)
    parts = [text(10, 20, "Wall time of a cold process, all hashes known (median of the rounds)", css="title"), *_key()]
    for tick in _ticks(axis):
        parts += [line(axis(tick), TOP - 12, axis(tick), bottom, css="grid"), text(axis(tick), bottom + 16, f"{tick:g} s", "middle", "soft")]
    for number, row in enumerate(rows):
        parts += _row(TOP + ROW * number + ROW / 2, row, [one for one in timings if (one.photos, one.verb) == row], axis)
    return page(WIDTH, bottom + 28, parts)


def _key() -> list[str]:
    places = [(LEFT + 110 * k, name) for k, name in enumerate(NAMES)]
    return [part for k, (x, name) in enumerate(places) for part in (dot(x, 38, COLOURS[k]), text(x + 10, 42, NAMES[name]))]


def _ticks(axis: LogAxis) -> list[float]:
    return [mantissa * decade for decade in [axis.decades()[0] / 10, *axis.decades()] for mantissa in (1, 2, 5) if axis.low < mantissa * decade < axis.high]


def _row(y: float, row: tuple[int, str], timings: Sequence[Any], axis: LogAxis) -> list[str]:
    parts = [text(LEFT - 14, y + 4, f"{3 * row[0] + 1} steps, {row[1]}", "end")]
    for one in timings:
        colour = COLOURS[list(NAMES).index(one.program)]
        parts.append(line(axis(min(one.wall)), y, axis(max(one.wall)), y, style=f"stroke: {colour}; stroke-width: 3; opacity: .35"))
        parts.append(dot(axis(median(one.wall)), y, colour))
    return parts
