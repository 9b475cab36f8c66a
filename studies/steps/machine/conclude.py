"""What the study comes to: writes table.csv, table.json, figure.svg and paragraph.md."""

from __future__ import annotations

from pathlib import Path

import msgspec

from factorlib.stage import Inputs, Progress
from studies.core.measures import MEASURES
from studies.core.statistics import spread
from studies.core.table import Conclusion
from studies.report.bars import bars
from studies.steps.conclusion import conclude


class Params(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Nothing to choose."""


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Sum up all runs."""
    conclude(inputs, out, notes=notes, drawn=bars)


def notes(found: Conclusion) -> list[str]:
    """The spread over all seeds as runs are, then what other instructions change of the same seeds."""
    fixed = [row for row in found.rows if row.name.startswith("fixed")]
    over = [
        _spread(measure, [v for row in fixed for v in row.cells[measure].values.values()]) for measure in found.measures
    ]
    return over + [
        _changed(row.label, row.cells, fixed[0].cells, found.measures)
        for row in found.rows
        if not row.name.startswith("fixed")
    ]


def _spread(measure: str, values: list[float]) -> str:
    s = spread(values)
    if s.deviation is None:
        return f"{MEASURES[measure].label}: {s.mean:.4g}, one seed."
    return f"{MEASURES[measure].label}: {s.mean:.4g} on average over {s.seeds} seeds, deviation {s.deviation:.2g}, {min(values):.4g} to {max(values):.4g}."


def _changed(label: str, cells: dict, fixed: dict, measures: tuple[str, ...]) -> str:
    apart = {m: max(abs(v - fixed[m].values[seed]) for seed, v in cells[m].values.items()) for m in measures}
    if not any(apart.values()):
        return f"{label}: every number is the same to the last digit."
    most = "; ".join(f"{MEASURES[m].label} by {v:.2g}" for m, v in apart.items() if v)
    return f"{label}: numbers of the same seed differ at most so: {most}."
