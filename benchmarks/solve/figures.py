"""Error over time, a panel per set: mean re-synthesis PSNR, wall time on a logarithmic axis."""

from __future__ import annotations

import math

from benchmarks.figure import COLOURS, LogAxis, dot, line, page, path, text

LEFT, WIDE, TALL, GAP = 60, 320, 200, 74


def error_over_time(sets: dict[str, dict]) -> str:
    """`sets`: {set: {"solvers": {label: {"points": […]}}}}; colours by label, the same in all panels."""
    labels = list(dict.fromkeys(label for table in sets.values() for label in table["solvers"]))
    columns, rows = min(2, len(sets)), -(-len(sets) // 2)
    height = 60 + rows * (TALL + GAP) + 18 * -(-len(labels) // 3)
    parts = [text(20, 22, "Mean PSNR of the re-synthesis over wall time", css="title")]
    for k, (name, table) in enumerate(sets.items()):
        parts += _panel(name, table["solvers"], labels, LEFT + (k % 2) * (WIDE + GAP), 56 + (k // 2) * (TALL + GAP))
    for k, label in enumerate(labels):
        x, y = 40 + 240 * (k % 3), 60 + rows * (TALL + GAP) + 18 * (k // 3)
        parts += [dot(x, y - 4, _colour(k), hollow=_hollow(k)), text(x + 12, y, label)]
    return page(LEFT + max(columns, 2) * (WIDE + GAP) - 40, height, parts)


def _colour(k: int) -> str:
    return COLOURS[k % len(COLOURS)]


def _hollow(k: int) -> bool:
    return k >= len(COLOURS)


def _panel(name: str, solvers: dict[str, dict], labels: list[str], left: float, top: float) -> list[str]:
    points = [p for row in solvers.values() for p in row["points"]]
    times, values = [max(p["wall"], 0.1) for p in points], [p["mean_db"] for p in points]
    across = LogAxis(10 ** math.floor(math.log10(min(times))), 10 ** math.ceil(math.log10(max(times)) + 1e-9), left, left + WIDE)
    low, high = 5 * math.floor(min(values) / 5), 5 * math.ceil(max(values) / 5) or 5

    def up(value: float) -> float:
        return top + TALL * (high - value) / max(high - low, 1)

    parts = [text(left, top - 8, name.replace("x", " × "), css="title")]
    for value in range(low, high + 1, 5):
        parts += [line(left, up(value), left + WIDE, up(value), "grid"), text(left - 6, up(value) + 4, f"{value}", "end", "soft small")]
    for value in across.decades():
        parts += [line(across(value), top, across(value), top + TALL, "grid"), text(across(value), top + TALL + 15, f"{value:g}", "middle", "soft small")]
    parts += [text(left + WIDE / 2, top + TALL + 32, "seconds", "middle", "soft"), text(left - 34, top + TALL / 2, "dB", "middle", "soft", -90)]
    for label, row in solvers.items():
        k = labels.index(label)
        shown = [(across(max(p["wall"], 0.1)), up(p["mean_db"])) for p in row["points"]]
        parts += [path(shown, _colour(k), dashed=_hollow(k)), *(dot(x, y, _colour(k), hollow=_hollow(k), radius=2.5) for x, y in shown)]
    return parts
