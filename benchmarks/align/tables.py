"""The benchmark's rows as tables for docs/align.md."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from benchmarks.align.cases import RIGHT, WRONG
from benchmarks.align.measure import RIGHT_DEG
from benchmarks.align.shapes import SHAPES
from benchmarks.markdown import exact, table


def as_tables(rows: list[dict]) -> dict[str, str]:
    return {"success": success(rows), "flags": flags(rows), "time": time(rows)}


def success(rows: list[dict]) -> str:
    """Per kind and shape: how many are right, and the errors."""
    body = []
    for kind in RIGHT:
        for shape in (*SHAPES, None):
            some = _of(rows, kind, shape)
            if some:
                errors = np.array([row["normal_error_deg"] for row in some])
                floor = np.median([row["of_the_mesh_deg"] for row in some])
                shares = _share(row["right"] for row in some), _share(bool(row["doubts"]) for row in some if row["right"])
                missed = _share(bool(row["doubts"]) for row in some if not row["right"])
                quantiles = ", ".join(exact(float(q)) for q in np.quantile(errors, (0.5, 0.9, 1)))
                body.append([f"{kind}, {shape or 'all'}", shares[0], quantiles, exact(float(floor)), shares[1], missed])
    head = ["case", f"right (≤ {RIGHT_DEG['exact']:.0f}°, rough ≤ {RIGHT_DEG['rough']:.0f}°)", "normal error: median, 90 %, worst (°)",
            "of the mesh alone (°)", "right but flagged", "wrong and flagged"]  # fmt: skip
    return table(head, body)


def flags(rows: list[dict]) -> str:
    body = []
    for kind in (*WRONG, None):
        some = [row for row in rows if row["kind"] in (WRONG if kind is None else (kind,))]
        if some:
            shapes = [_share(bool(row["doubts"]) for row in some if row["shape"] == shape) for shape in SHAPES]
            body.append([kind or "all", _share(bool(row["doubts"]) for row in some), *shapes])
    return table(["provoked", "flagged", *SHAPES], body)


def time(rows: list[dict]) -> str:
    body = []
    for kind in RIGHT + WRONG:
        some = _of(rows, kind, None)
        if some:
            seconds = [
                ", ".join(exact(float(q)) for q in np.quantile([r[key] for r in some], (0.5, 1))) for key in ("processor_s", "wall_s")
            ]
            body.append([kind, *seconds, str(max(row["memory_mb"] for row in some))])
    return table(["case", "processor: median, worst (s)", "wall: median, worst (s)", "memory (MB)"], body)


def _of(rows: list[dict], kind: str, shape: str | None) -> list[dict]:
    return [row for row in rows if row["kind"] == kind and shape in (None, row["shape"])]


def _share(flags: Iterable[bool]) -> str:
    """
    >>> _share([True, False]), _share([])
    ('1 of 2', '–')
    """
    flags = list(flags)
    return f"{sum(flags)} of {len(flags)}" if flags else "–"
