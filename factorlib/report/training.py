"""How exact the reflection networks are, as the stage `train` measured it."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping

import msgspec

from factorlib.jsonfile import read_json
from factorlib.report.artifacts import Artifacts
from factorlib.report.plot import Series, line_plot
from factorlib.report.text import significant

CURVES = {"held_out_median_error": "median", "held_out_p95_error": "95th percentile"}  # columns of training.parquet
MEASURES = {
    "median": "median",
    "p95": "95th percentile",
    "p99": "99th percentile",
    "worst": "worst",
    "samples": "samples",
}
ERROR = "relative error, %"
Plot = tuple[str, list[str]]  # an SVG, and the names of its lines


class Line(msgspec.Struct, frozen=True):
    """A line of the table: level 0 is a network, 1 a quantity, 2 a bin of it; cells are empty where nothing is measured."""

    level: int
    name: str
    cells: list[str]


class Training(msgspec.Struct, frozen=True):
    """columns: names of the measures that occur;  curve: of the training;  bins: errors by quantity."""

    columns: list[str]
    lines: list[Line]
    curve: Plot
    bins: list[Plot]


def training_of(run: Artifacts) -> Training | None:
    """accuracy.json is {network: {measure: number, quantity: {bin: {measure: number}}}}."""
    accuracy = run.read(read_json, "train", "accuracy.json")
    if accuracy is None:
        return None
    columns = [key for key in MEASURES if f"'{key}'" in str(accuracy)]
    lines = [line for part, table in sorted(accuracy.items(), reverse=True) for line in _lines(part, table, columns, 0)]
    plots = [_binned(*item) for item in accuracy.get("specular", {}).items() if isinstance(item[1], dict)]
    bins = [plot for plot in plots if plot[0]]
    return Training([MEASURES[key] for key in columns], lines, _curve(run.table("train", "training")), bins)


def _lines(name: str, table: Mapping, columns: list[str], level: int) -> Iterator[Line]:
    yield Line(level, name, [_cell(key, table.get(key)) for key in columns])
    for key in _in_order(key for key, value in table.items() if isinstance(value, dict)):
        yield from _lines(key, table[key], columns, level + 1)


def _cell(key: str, value: float | None) -> str:
    if value is None:
        return ""
    return str(value) if key == "samples" else f"{significant(100 * value, 2)} %"


def _in_order(names: Iterator[str] | Mapping) -> list[str]:
    """Bins in the order of what they hold, by their leading numbers: "3 to 30" before "30 to 300"."""

    def leading(name: str) -> tuple[float, str]:
        """The number that a name begins with, 0 for none, and the name."""
        number = re.match(r"[-+]?[\d.]+(e[-+]?\d+)?", name)
        return float(number[0]) if number else 0.0, name

    return sorted(names, key=leading)


def _binned(quantity: str, bins: Mapping[str, Mapping[str, float]]) -> Plot:
    """The specular error by bins of a quantity: median, and 95th percentile."""
    names = _in_order(bins)
    values = {key: [100 * bins[name].get(key, math.nan) for name in names] for key in ("median", "p95")}
    series = [Series(MEASURES[key], range(len(names)), each) for key, each in values.items()]
    return line_plot(series, quantity, ERROR, log_y=True, names=names), [s.name for s in series]


def _curve(table: dict[str, list]) -> Plot:
    """Median error of each network, and the 95th percentile, by step; columns are part, step and `CURVES`."""
    series = []
    for part in sorted(set(table.get("part", [])), reverse=True):
        rows = [k for k, name in enumerate(table["part"]) if name == part]
        for column in [column for column in CURVES if column in table]:
            steps, errors = [table["step"][k] for k in rows], [100 * table[column][k] for k in rows]
            series.append(Series(f"{part}, {CURVES[column]}", steps, errors))
    return line_plot(series, "training step", ERROR, log_y=True), [s.name for s in series]
