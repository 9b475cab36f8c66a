"""What the study comes to, and which cases are worst: writes table.csv, table.json, figure.svg and paragraph.md."""

from __future__ import annotations

from pathlib import Path

import msgspec

from factorlib.stage import Inputs, Progress
from studies.core.measures import MEASURES
from studies.core.table import Conclusion
from studies.report.bars import bars
from studies.steps.conclusion import conclude

WORST = 3  # cases of a measure that are named


class Params(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Nothing to choose."""


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Sum up all cases."""
    conclude(
        inputs,
        out,
        notes=lambda found: [worst(found, m) for m in found.measures if any(m in row.cells for row in found.rows)],
        drawn=bars,
    )


def worst(found: Conclusion, measure: str) -> str:
    """The cases whose worst seed is worst, as a sentence."""
    of = {row.label: max(row.cells[measure].values.values()) for row in found.rows if measure in row.cells}
    ranked = sorted(of, key=of.get, reverse=True)[:WORST]
    return (
        f"{MEASURES[measure].label}, worst of all seeds: "
        + "; ".join(f"{label.partition(': ')[2]} {of[label]:.3g}" for label in ranked)
        + "."
    )
