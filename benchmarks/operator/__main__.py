"""Time and error of every reflection operator: writes operator.json and figures to build/bench/operator.

`python -m benchmarks.operator [--docs]`; --docs also refreshes the figures and tables of docs/operator.md.
"""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Annotated

import torch
import typer

from benchmarks.markdown import refresh
from benchmarks.operator import stability
from benchmarks.operator.errors import diffuse_errors, gradient_errors, gradients, specular_errors
from benchmarks.operator.figures import errors_by_input, time_against_error
from benchmarks.operator.tables import as_tables
from benchmarks.operator.timing import cuda_rates, microseconds
from benchmarks.operator.variants import fast_names, of_dtype, variants
from factorlib.jsonfile import write_json
from factorlib.reflection.reference import Reference
from factorlib.reflection.samples import diffuse_samples, specular_samples

ROOT = Path(__file__).resolve().parents[2]
TOLERANCES = {"reference 10⁻²": 1e-2, "reference 10⁻⁴": 1e-4, "reference": 1e-7}
FIGURES = ("time_against_error.svg", "errors_by_input.svg")


def measured(count: int, gradient_count: int = 512) -> dict:
    """{"operators": {label: {"microseconds", "specular", "diffuse", "gradients"}}, "bfloat16": …, "cuda": …}."""
    fast = variants()
    references = {label: Reference(tolerance=tolerance) for label, tolerance in TOLERANCES.items()}
    times = microseconds(fast | references, lambda label: 8 if label in references else 1024)
    specular, diffuse = specular_samples(count, 99, tolerance=1e-7), diffuse_samples(count, 98)
    exact = gradients(references["reference"], gradient_count)
    rows: dict[str, dict] = {label: {"microseconds": times[label]} for label in times}
    for label, operator in fast.items():
        rows[label] |= {"specular": specular_errors(operator, specular), "diffuse": diffuse_errors(operator, diffuse)}
        rows[label]["gradients"] = gradient_errors(operator, exact, gradient_count)
    for label, operator in references.items():
        if label != "reference":
            rows[label]["specular"] = specular_errors(operator, specular)
    return {
        "operators": rows,
        "bfloat16": bfloat16(specular, diffuse),
        "cuda": cuda_rates({k: o for k, o in fast.items() if "torch" not in k}),
    }


def bfloat16(specular, diffuse) -> dict:
    """Formulas and weights in bfloat16, inputs rounded to it, by torch."""
    operators = {name: operator for name in fast_names() if (operator := of_dtype(name, torch.bfloat16)) is not None}
    return {
        name: {"specular": specular_errors(o, specular), "diffuse": diffuse_errors(o, diffuse)}
        for name, o in operators.items()
    }


def main(
    samples: Annotated[int, typer.Option(help="of the reference")] = 16384,
    docs: Annotated[bool, typer.Option(help="also refresh docs/operator.md and its figures")] = False,
    out: Annotated[Path, typer.Option(help="folder to write to")] = ROOT / "build" / "bench" / "operator",
) -> None:
    torch.set_num_threads(1)
    out.mkdir(parents=True, exist_ok=True)
    result = measured(samples)
    write_json(out / "operator.json", result)
    (out / FIGURES[0]).write_text(time_against_error(result["operators"]), encoding="utf-8")
    (out / FIGURES[1]).write_text(errors_by_input(result["operators"]), encoding="utf-8")
    laws = stability.measured()
    write_json(out / "stability.json", laws)
    if docs:
        folder = ROOT / "docs" / "operator"
        folder.mkdir(exist_ok=True)
        for name in FIGURES:
            shutil.copy(out / name, folder / name)
        refresh(stability.DOCS, as_tables(result))
        refresh(stability.DOCS, stability.as_tables(laws))
    print(f"{out}: operator.json, stability.json, {', '.join(FIGURES)}")


if __name__ == "__main__":
    typer.run(main)
