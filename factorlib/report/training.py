"""How exact the reflection networks are, as the stage `train` measured it."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator

import msgspec

from factorlib.report.artifacts import Artifacts
from factorlib.report.plot import Series, line_plot
from factorlib.report.text import significant

CURVES = {"held_out_median_error": "median", "held_out_p95_error": "95th percentile"}  # columns of training.parquet
MEASURES = {"median": "median", "p95": "95th percentile", "p99": "99th percentile", "worst": "worst", "samples": "samples"}


class Line(msgspec.Struct, frozen=True):
    """A line of the table: level 0 is a network, 1 a quantity, 2 a bin of it; cells are empty where nothing is measured."""

    level: int
    name: str
    cells: list[str]


class Training(msgspec.Struct, frozen=True):
    """columns: names of the measures that occur;  curve: an SVG (or empty) and its lines;  bins: the same, by quantity."""

    columns: list[str]
    lines: list[Line]
    curve: tuple[str, list[str]]
    bins: list[tuple[str, list[str]]]


def training_of(run: Artifacts) -> Training | None:
    """accuracy.json is {network: {measure: number, quantity: {bin: {measure: number}}}}."""
    accuracy = run.accuracy()
    if accuracy is None:
        return None
    text = str(accuracy)
    columns = [key for key in MEASURES if f"'{key}'" in text]
    lines = [line for part, found in sorted(accuracy.items(), reverse=True) for line in _lines(part, found, columns, 0)]
    return Training([MEASURES[key] for key in columns], lines, _curve(run.training()), _bins(accuracy.get("specular", {})))


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


def _bins(specular: dict) -> list[tuple[str, list[str]]]:
    """A plot per quantity that the specular error was binned by: median, and 95th percentile."""
    found = []
    for quantity, bins in specular.items():
        if isinstance(bins, dict):
            names = sorted(bins, key=lambda name: (_leading_number(name), name))
            series = [
                Series(MEASURES[key], range(len(names)), [100 * bins[name].get(key, math.nan) for name in names])
                for key in ("median", "p95")
            ]
            found.append((line_plot(series, quantity, "relative error, %", log_y=True, names=names), [s.name for s in series]))
    return [plot for plot in found if plot[0]]


def _curve(table: dict[str, list]) -> tuple[str, list[str]]:
    """Median error of each network, and the 95th percentile, by step; the table is the stage's, part, step and `CURVES`."""
    parts = list(dict.fromkeys(table.get("part", [])))
    series = [_series(table, part, measure) for part in sorted(parts, reverse=True) for measure in CURVES if measure in table]
    return line_plot(series, "training step", "relative error, %", log_y=True), [s.name for s in series]


def _series(table: dict[str, list], part: str, measure: str) -> Series:
    rows = [k for k, name in enumerate(table["part"]) if name == part]
    return Series(f"{part}, {CURVES[measure]}", [table["step"][k] for k in rows], [100 * table[measure][k] for k in rows])
