"""How exact the reflection networks are, as the stage `train` measured it."""

from __future__ import annotations

import msgspec

from factorlib.report.artifacts import Artifacts
from factorlib.report.plot import Series, line_plot
from factorlib.report.text import significant


class Training(msgspec.Struct, frozen=True):
    """rows: (what was measured, its numbers by name);  columns: all such names;  curve: an SVG (or empty) and its lines."""

    columns: list[str]
    rows: list[tuple[str, dict[str, str]]]
    curve: tuple[str, list[str]]


def training_of(run: Artifacts) -> Training | None:
    accuracy = run.json("train", "accuracy.json")
    if accuracy is None:
        return None
    rows = list(_leaves(accuracy, ()))
    columns = list(dict.fromkeys(name for _, numbers in rows for name in numbers))
    return Training(columns, rows, _curve(run.training()))


def _leaves(value: dict, path: tuple[str, ...]):
    """Every dictionary that holds numbers, by its path."""
    numbers = {k: significant(v) for k, v in value.items() if isinstance(v, int | float) and not isinstance(v, bool)}
    if numbers:
        yield " · ".join(path) or "all", numbers
    for key, inner in value.items():
        if isinstance(inner, dict):
            yield from _leaves(inner, (*path, key))


def _curve(table: dict[str, list]) -> tuple[str, list[str]]:
    """Median error of each network, and the 95th percentile, by step; the table has part, step, median and p95."""
    parts = list(dict.fromkeys(table.get("part", [])))
    series = [_series(table, part, measure) for part in sorted(parts, reverse=True) for measure in ("median", "p95") if measure in table]
    return line_plot(series, "training step", "relative error", log_y=True), [s.name for s in series]


def _series(table: dict[str, list], part: str, measure: str) -> Series:
    rows = [k for k, name in enumerate(table["part"]) if name == part]
    name = f"{part}, {'median' if measure == 'median' else '95th percentile'}"
    return Series(name, [table["step"][k] for k in rows], [table[measure][k] for k in rows])
