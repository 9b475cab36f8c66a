"""How far the hard cases' errors spread over differently trained weights and over noise: what their bounds must leave room for.

`python -m benchmarks.solve_spread FOLDER … [--seeds 3]` solves every case of benchmarks/solve/hard_cases.py with the operator of each folder
of weights (as the stage `train` writes them), and with as many seeds of noise, and prints the worst of each error beside its bound.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import torch
import typer

from benchmarks.markdown import table
from benchmarks.rounded import exact
from benchmarks.solve import hard_cases
from benchmarks.solve.hard_cases import BOUNDS, CASES, answered
from factorlib.reflection import reflection_operator

ERRORS = ("k", "roughness", "radiance")


def worst(case: str, weights: list[Path], seeds: int) -> dict[str, float]:
    """The largest of each error over all weights and seeds."""
    answers = []
    for folder in weights:
        hard_cases.OPERATOR = reflection_operator("network", weights=folder)  # what is seen is rendered by the operator that solves
        answers += [answered(CASES[case](seed), operator=hard_cases.OPERATOR) for seed in range(seeds)]
    return {error: max(getattr(answer, error) for answer in answers) for error in ERRORS}


def main(
    weights: Annotated[list[Path], typer.Argument(help="folders of trained weights")],
    seeds: Annotated[int, typer.Option(help="of noise")] = 3,
) -> None:
    torch.set_num_threads(1)
    rows = []
    for case, bound in BOUNDS.items():
        found = worst(case, weights, seeds)
        cells = [f"{found[error]:.2g} ({'none' if getattr(bound, error) is None else exact(getattr(bound, error))})" for error in ERRORS]
        rows.append([case, *cells])
        print(" | ".join(rows[-1]), flush=True)
    print(table(["case", *(f"{error}: worst (bound)" for error in ERRORS)], rows))


if __name__ == "__main__":
    typer.run(main)
