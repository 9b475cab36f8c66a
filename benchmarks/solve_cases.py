"""The hard cases of the joint solve, measured: `python -m benchmarks.solve_cases [--docs]`; --docs refreshes docs/solve.md.

The cases, their errors and bounds are those of benchmarks/solve/hard_cases.py.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import typer

from benchmarks.markdown import refresh, table
from benchmarks.rounded import exact
from benchmarks.solve.hard_cases import BOUNDS, CASES, answered, of_random_starts
from factorlib.jsonfile import json_text
from factorlib.reflection import reflection_operator

DOCS = Path(__file__).resolve().parents[1] / "docs" / "solve.md"
SAID = {  # words of a message -> what the table calls it
    "is flat": "flat",
    "observation(s), fewer": "few observations",
    "and a smooth material in a soft light": "one material, one light",
    "by convention only. A photo": "one material",
    "clipped and say": "clipped",
    "so dark": "dark",
    "part look alike": "reflectance",
    "cannot be determined": "roughness",
    "may be smoother": "smoothest",
    "differ from the answer": "ill explained",
}
STARTS = ("1 material × 1 light", "ordinary: 2 materials × 2 lights", "5 materials × 1 light")


def measured() -> dict:
    """{"cases": {case: {error: value, "said": [...]}}, "starts": {case: [same, of]}, "single against double": largest difference}."""
    cases = {}
    for name, make in CASES.items():
        answer = answered(make(0))
        said = list(dict.fromkeys(short for sentence in answer.said for words, short in SAID.items() if words in sentence))
        cases[name] = {error: float(f"{getattr(answer, error):.2g}") for error in ("k", "roughness", "radiance")} | {"said": said}
    return {"cases": cases, "starts": {name: _same(name) for name in STARTS}, "single against double": _single_against_double()}


def _same(name: str) -> list[int]:
    answers, bound = of_random_starts(CASES[name](0)), BOUNDS[name]
    return [sum(a.k <= bound.k and a.roughness <= bound.roughness for a in answers), len(answers)]


def _single_against_double() -> float:
    given = CASES[STARTS[0]](0)
    single, double = (answered(given, operator=reflection_operator("network", dtype=dtype)) for dtype in ("float32", "float64"))
    return float(f"{np.abs(single.materials.vector() - double.materials.vector()).max():.2g}")


def as_tables(result: dict) -> dict[str, str]:
    rows = []
    for name, found in result["cases"].items():
        cells = [_cell(found[error], getattr(BOUNDS[name], error)) for error in ("k", "roughness", "radiance")]
        rows.append([name, *cells, ", ".join(found["said"])])
    starts = [[name, f"{same} of {of}"] for name, (same, of) in result["starts"].items()]
    return {
        "cases": table(["case", "reflectance (bound)", "roughness (bound)", "radiance (bound)", "said"], rows),
        "starts": table(["case", "the same answer"], starts),
        "precision": f"Largest difference of a material's unknowns: {exact(result['single against double'])}.",
    }


def _cell(value: float, bound: float | None) -> str:
    return f"{exact(value)} ({'none' if bound is None else exact(bound)})"


def main(docs: Annotated[bool, typer.Option(help="also refresh the tables in docs/solve.md")] = False) -> None:
    torch.set_num_threads(1)
    result = measured()
    print(json_text(result), end="")
    if docs:
        refresh(DOCS, as_tables(result))


if __name__ == "__main__":
    typer.run(main)
