"""Special cases and laws, measured: `python -m benchmarks.operator.stability [--docs]`; --docs refreshes docs/operator.md.

Errors are |R − S| / (S + E/100); of gradients |∂R − ∂S| / (|∂S| + S + E/100), lobe, view and normal turning.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import torch
import typer

from benchmarks.markdown import refresh, table
from benchmarks.operator import laws
from benchmarks.operator.cases import ALL, CASES, case
from benchmarks.operator.rounding import measures
from benchmarks.operator.variants import variants
from benchmarks.rounded import exact
from factorlib.jsonfile import json_text

DOCS = Path(__file__).resolve().parents[2] / "docs" / "operator.md"
LAWS = {
    "reflection of a unit lobe, at most 1: roughness ≥ .1, n·o ≥ .02": lambda o: laws.unit_lobes(o, laws.USUAL),
    "… roughness ≥ .1, n·o ≥ 10⁻⁴": lambda o: laws.unit_lobes(o, laws.WIDER),
    "… roughness ≥ .03, n·o ≥ 10⁻⁴": lambda o: laws.unit_lobes(o, laws.WHOLE),
    "least of it, at least 0": laws.least_reflected,
    "GGX of k_s = 1 under constant light, at most 1": laws.constant_light,
    "white Lambert under constant light, distance from 1": laws.white_lambert,
    "point light (λ = 10⁶), distance from the BRDF": laws.point_light,
    "everything turned: change over the largest radiance": laws.turned,
    "weights times 10⁶: relative change of radiance / 10⁶": laws.scaled,
}


def measured() -> dict:
    """{"cases": {case: {operator: {measure: number}}}, "laws": {law: {operator: [p99, worst] or [worst]}}}."""
    fast = variants(("float32", "float64"))
    shown = {label: operator for label, operator in fast.items() if "float64" not in label}
    rows = {name: measures(case(name), shown, fast, name != ALL) for name in (*CASES, ALL)}
    by_law = {
        law: {label: [float(f"{v:.4g}") for v in measure(o)] for label, o in shown.items()}
        for law, measure in LAWS.items()
    }
    return {"cases": rows, "laws": by_law}


def as_tables(result: dict) -> dict[str, str]:
    labels = list(next(iter(result["cases"].values())))
    head = [label.replace("_", " ").replace(" float32", "") for label in labels]

    def cells(row: dict, *names: str) -> list[str]:
        return [" / ".join(exact(row[label][n]) if n in row[label] else "–" for n in names) for label in labels]

    finite = {
        name: ["" if row[label]["finite"] else " **not finite**" for label in labels]
        for name, row in result["cases"].items()
    }
    rounding = [
        [name, *(a + b for a, b in zip(cells(row, "value_rounding", "gradient_rounding"), finite[name], strict=True))]
        for name, row in result["cases"].items()
    ]
    values = [[name, *cells(row, "value")] for name, row in result["cases"].items() if name != ALL]
    by_law = [
        [law, *(" / ".join(exact(v, 4 if v > 0.1 else 2) for v in row[label]) for label in labels)]
        for law, row in result["laws"].items()
    ]
    return {
        "stability": table(["changed", *head], rounding),
        "special values": table(["changed", *head], values),
        "laws": table(["law", *head], by_law),
    }


def main(docs: Annotated[bool, typer.Option(help="also refresh the tables in docs/operator.md")] = False) -> None:
    torch.set_num_threads(1)
    result = measured()
    print(json_text(result), end="")
    if docs:
        refresh(DOCS, as_tables(result))


if __name__ == "__main__":
    typer.run(main)
