"""How far the numbers of data/synthetic lie apart between networks trained from other seeds and solves of other seeds.

`python -m benchmarks.synthetic_spread [--weights 5] [--seeds 2]` runs the pipeline for each, prints every number that `make test` holds
to a bound with its median and its worst, and the bound that lies a quarter of the error beyond the worst.  Networks of other seeds
are trained once (some ten minutes each) and kept in the store.
"""

from __future__ import annotations

import math
from typing import Annotated

import numpy as np
import typer

from factorlib.evaluate.table import SYNTHETIC, Bound, rows_of
from factorlib.jsonfile import read_json
from factorlib.runner import verbs
from factorlib.runner.project import LIBRARY, Project, photo_sets

MARGIN = 1.25  # of the worst error


def numbers(project: Project, settings: str) -> list[float]:
    """The value of each bound in `SYNTHETIC`, of a run with these settings."""
    if verbs.make(project, verbs.Wish("synthetic", ["evaluate"], [settings])) != 0:
        raise SystemExit(1)
    rows = rows_of(read_json(project.build / "synthetic" / "evaluate" / "metrics.json"), SYNTHETIC)
    return [math.nan if row.value is None else row.value for row in rows]


def worst_and_bound(bound: Bound, values: np.ndarray) -> tuple[float, float]:
    """The worst of the values, and that with an error larger by a quarter."""
    if bound.sense == "≤":
        return float(values.max()), float(MARGIN * values.max())
    return float(values.min()), float(values.min() - 20 * math.log10(MARGIN))


def main(
    weights: Annotated[int, typer.Option(help="how many trained networks", min=1)] = 5,
    seeds: Annotated[int, typer.Option(help="how many seeds of the solve", min=1)] = 2,
) -> None:
    """Print the spread."""
    project = Project(LIBRARY, photo_sets())
    settings = [f"train.seed={w} solve.seed={s}" for w in range(weights) for s in range(seeds)]
    table = np.array([numbers(project, each) for each in settings])
    print(f"{weights} networks × {seeds} seeds\n{'':56} {'median':>9} {'worst':>9} {'bound':>9}")
    for bound, values in zip(SYNTHETIC, table.T, strict=True):
        worst, limit = worst_and_bound(bound, values)
        print(f"{bound.meaning:56} {np.median(values):9.4g} {worst:9.4g} {limit:9.4g}")


if __name__ == "__main__":
    typer.run(main)
