"""Metrics against bounds, as a table a person can read when a regression test fails.

python -m factorlib.evaluate.table build/synthetic/evaluate/metrics.json
"""

from __future__ import annotations

import sys
from collections.abc import Iterable

import msgspec

from factorlib.results.metrics import read_metrics


class Bound(msgspec.Struct, frozen=True):
    """A dotted path into metrics.json, "≤" or "≥", the limit, a unit, and a word on what it is."""

    path: str
    sense: str
    limit: float
    unit: str
    meaning: str


class Row(msgspec.Struct, frozen=True):
    """A bound and its value: None where the path leads nowhere, which is not ok."""

    bound: Bound
    value: float | None

    @property
    def ok(self) -> bool:
        """Whether the value is there and within its bound."""
        sign = 1 if self.bound.sense == "≤" else -1
        return self.value is not None and sign * self.value <= sign * self.bound.limit


# A quarter beyond the worst of five trained networks × two seeds of the solve.
SPHERE, RMS = "light.mean.channel_per_photo.{}.estimate.rmse", "sphere, of the truth's RMS"
SYNTHETIC = (
    Bound("materials.worst_roughness", "≤", 0.040, "", "roughness, worst material"),
    Bound("materials.worst_diffuse", "≤", 0.055, "", "diffuse, worst material and channel, relative"),
    Bound("materials.worst_specular", "≤", 0.038, "", "specular, worst material and channel, relative"),
    Bound("resynthesis.worst_psnr_linear_db", "≥", 35.0, "dB", "re-synthesis, worst photo, no gauge, linear"),
    Bound("resynthesis.worst_psnr_tonemapped_db", "≥", 40.4, "dB", "re-synthesis, worst photo, no gauge, tone-mapped"),
    Bound("relighting.mean.scalar_per_set.in_true_light.psnr_tonemapped_db", "≥", 38.0, "dB", "relit balls, one scalar per set"),
    Bound(SPHERE.format("mirror"), "≤", 0.276, "", f"mirror {RMS}"),
    Bound(SPHERE.format("glossy"), "≤", 0.076, "", f"glossy {RMS}"),
    Bound(SPHERE.format("lambertian"), "≤", 0.005, "", f"Lambertian {RMS}"),
)  # fmt: skip


def value_at(metrics: object, path: str) -> float | None:
    """What stands at a dotted path; None where there is nothing.

    >>> value_at({"a": {"b": [1.5]}}, "a.b.0"), value_at({"a": None}, "a.b")
    (1.5, None)
    """
    for key in path.split("."):
        try:
            metrics = metrics[int(key)] if isinstance(metrics, list) else metrics[key]
        except (LookupError, TypeError, ValueError):
            return None
    return metrics


def rows_of(metrics: object, bounds: Iterable[Bound]) -> list[Row]:
    """The value of every bound, looked up in `metrics` by the bound's dotted path."""
    return [Row(bound, value_at(metrics, bound.path)) for bound in bounds]


def table_text(rows: list[Row]) -> str:
    """metric, value, bound, ok: one line each, in columns.

    >>> print(table_text([Row(Bound("a", "≤", 0.05, "", "roughness"), 0.0123)]))
    metric     value   bound   ok   path
    roughness  0.0123  ≤ 0.05  yes  a
    """
    cells = [("metric", "value", "bound", "ok", "path"), *(_cells(row.bound, row) for row in rows)]
    widths = [max(len(c[k]) for c in cells) for k in range(4)]
    return "\n".join("  ".join([c.ljust(w) for c, w in zip(line, widths, strict=False)] + [line[4]]) for line in cells)


def _cells(bound: Bound, row: Row) -> tuple[str, str, str, str, str]:
    unit = f" {bound.unit}" if bound.unit else ""
    value = "missing" if row.value is None else f"{row.value:.4g}{unit}"
    return bound.meaning, value, f"{bound.sense} {bound.limit:g}{unit}", "yes" if row.ok else "NO", bound.path


def main(path: str) -> int:
    """Print the table of the bounds of data/synthetic; 1 if any is broken."""
    rows = rows_of(msgspec.to_builtins(read_metrics(path)), SYNTHETIC)
    print(table_text(rows))
    return 0 if all(row.ok for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
