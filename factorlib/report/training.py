"""How exact the reflection networks are, as the stage `train` measured it."""

from __future__ import annotations

import re
from collections.abc import Iterator

import msgspec

from factorlib.report.artifacts import Artifacts
from factorlib.report.plot import Series, line_plot
from factorlib.report.text import significant

MEASURES = {"median": "median", "p95": "95th percentile", "p99": "99th percentile", "worst": "worst", "samples": "samples"}


class Line(msgspec.Struct, frozen=True):
    """A line of the table: level 0 is a network, 1 a quantity, 2 a bin of it; cells are empty where nothing is measured."""

    level: int
    name: str
    cells: list[str]


class Training(msgspec.Struct, frozen=True):
    """columns: names of the measures that occur;  curve: an SVG (or empty) and its lines."""

    columns: list[str]
    lines: list[Line]
    curve: tuple[str, list[str]]


def training_of(run: Artifacts) -> Training | None:
    """accuracy.json is {network: {measure: number, quantity: {bin: {measure: number}}}}."""
    accuracy = run.json("train", "accuracy.json")
    if accuracy is None:
        return None
    text = str(accuracy)
    columns = [key for key in MEASURES if f"'{key}'" in text]
    lines = [line for part, found in sorted(accuracy.items(), reverse=True) for line in _lines(part, found, columns, 0)]
    return Training([MEASURES[key] for key in columns], lines, _curve(run.training()))


def _lines(name: str, found: dict, columns: list[str], level: int) -> Iterator[Line]:
    yield Line(level, name, [_cell(key, found.get(key)) for key in columns])
    inner = [(key, value) for key, value in found.items() if isinstance(value, dict)]
    for key, value in sorted(inner, key=lambda item: (_leading_number(item[0]), item[0])):
        yield from _lines(key, value, columns, level + 1)


def _cell(key: str, value: float | None) -> str:
    if value is None:
        return ""
    return str(value) if key == "samples" else f"{significant(100 * value, 2)} %"


def _leading_number(name: str) -> float:
    """So that bins stand in the order of what they hold: "3 to 30" before "30 to 300"."""
    found = re.match(r"[-+]?[\d.]+(e[-+]?\d+)?", name)
    return float(found[0]) if found else 0.0


def _curve(table: dict[str, list]) -> tuple[str, list[str]]:
    """Median error of each network, and the 95th percentile, by step; the table has part, step, median and p95."""
    parts = list(dict.fromkeys(table.get("part", [])))
    series = [_series(table, part, measure) for part in sorted(parts, reverse=True) for measure in ("median", "p95") if measure in table]
    return line_plot(series, "training step", "relative error", log_y=True), [s.name for s in series]


def _series(table: dict[str, list], part: str, measure: str) -> Series:
    rows = [k for k, name in enumerate(table["part"]) if name == part]
    name = f"{part}, {'median' if measure == 'median' else '95th percentile'}"
    return Series(name, [table["step"][k] for k in rows], [table[measure][k] for k in rows])
