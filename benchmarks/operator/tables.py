"""The benchmark's numbers as tables for docs/operator.md."""

from __future__ import annotations

from benchmarks.markdown import table
from benchmarks.operator.figures import name_of, variant_of
from benchmarks.rounded import exact

QUANTILES = ("median", "p95", "p99", "worst")
SLOPES = {"roughness": "roughness", "log_sharpness": "log λ", "no": "n·o", "nz": "n·z", "oz": "o·z"}


def as_tables(result: dict) -> dict[str, str]:
    rows = result["operators"]
    return {
        "time": times(rows),
        "errors": errors(rows),
        "gradients": gradients(rows),
        "bfloat16": bfloat16(result["bfloat16"]),
    }


def title(label: str) -> str:
    return f"{name_of(label)} {variant_of(label)}".strip()


def percent(value: float) -> str:
    return f"{exact(100 * value)} %"


def times(rows: dict[str, dict]) -> str:
    """Microseconds, and how many times the fastest's."""
    key = "values_and_gradients"
    fastest = min(row["microseconds"][key]["median"] for row in rows.values())
    body = [
        [title(label), *_times(row["microseconds"]), f"{exact(row['microseconds'][key]['median'] / fastest)} ×"]
        for label, row in rows.items()
    ]
    return table(["µs per evaluation: least, median", "values", "values and gradients", "of the fastest"], body)


def _times(row: dict[str, dict]) -> list[str]:
    return [f"{exact(row[key]['least'])}, {exact(row[key]['median'])}" for key in ("values", "values_and_gradients")]


def errors(rows: dict[str, dict]) -> str:
    body = [
        [f"{title(label)}, {part}", *(percent(row[part][q]) for q in QUANTILES)]
        for part in ("specular", "diffuse")
        for label, row in rows.items()
        if part in row
    ]
    return table(["error", *QUANTILES], body)


def gradients(rows: dict[str, dict]) -> str:
    body = [
        [f"{title(label)}, by {words}", *(percent(row["gradients"][slope][q]) for q in QUANTILES)]
        for label, row in rows.items()
        if "gradients" in row and label.endswith("float32")
        for slope, words in SLOPES.items()
    ]
    return table(["error of the derivative", *QUANTILES], body)


def bfloat16(rows: dict[str, dict]) -> str:
    body = [
        [
            f"{name.replace('_', ' ')}, {part}",
            *(percent(found[part][q]) if q in found[part] else "–" for q in QUANTILES),
            str(found[part].get("not finite", 0)),
        ]
        for name, found in rows.items()
        for part in ("specular", "diffuse")
    ]
    return table(["bfloat16", *QUANTILES, "not finite"], body)
