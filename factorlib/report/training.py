"""How exact the reflection networks are, as the stage `train` measured it."""

from __future__ import annotations

import msgspec

from factorlib.report.artifacts import Artifacts
from factorlib.report.plot import Series, line_plot
from factorlib.report.text import significant


class Training(msgspec.Struct, frozen=True):
    """rows: (what was measured, its numbers by name);  columns: all such names;  curve: an SVG or empty text."""

    columns: list[str]
    rows: list[tuple[str, dict[str, str]]]
    curve: str


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


def _curve(table: dict[str, list]) -> str:
    x = next((table[k] for k in ("step", "iteration", "epoch") if k in table), None)
    names = [k for k in table if "loss" in k or "error" in k]
    return "" if x is None else line_plot([Series(n, x, table[n]) for n in names], "training step", "loss", log_y=True)
