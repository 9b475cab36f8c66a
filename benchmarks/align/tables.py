"""The benchmark's rows as tables for docs/align.md."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from benchmarks.align.cases import RIGHT, WRONG
from benchmarks.align.measure import RIGHT_DEG
from benchmarks.align.real import common_turn
from benchmarks.align.shapes import SHAPES
from benchmarks.markdown import table
from benchmarks.rounded import exact


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
                shares = (
                    _share(row["right"] for row in some),
                    _share(bool(row["doubts"]) for row in some if row["right"]),
                )
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
                ", ".join(exact(float(q)) for q in np.quantile([r[key] for r in some], (0.5, 1)))
                for key in ("processor_s", "wall_s")
            ]
            body.append([kind, *seconds, str(max(row["memory_mb"] for row in some))])
    return table(["case", "processor: median, worst (s)", "wall: median, worst (s)", "memory (MB)"], body)


def real_tables(rows: list[dict]) -> dict[str, str]:
    return {"real-sets": real_sets(rows), "real-photos": real_photos(rows)}


def real_sets(rows: list[dict]) -> str:
    """Per real set and object: medians and the worst."""
    body = []
    for name in dict.fromkeys((row["set"], row["object"]) for row in rows):
        some = [row for row in rows if (row["set"], row["object"]) == name]
        common, left = common_turn([row["turn"] for row in some])
        angles = [[row[key] for row in some] for key in ("normal_error_deg", "rotation_error_deg", "about_the_ray_deg")]
        cells = [f"{np.median(each):.1f}, {max(each):.1f}" for each in (*angles, left)]
        ratios = [row["focal_ratio"] for row in some]
        seconds = (
            f"{np.median([row['processor_s'] for row in some]):.0f}, {max(row['processor_s'] for row in some):.0f}"
        )
        share = _share(bool(row["doubts"]) for row in some)
        spread = f"{min(ratios):.2f} to {max(ratios):.2f}"
        body.append([" ".join(name), str(len(some)), *cells[:3], f"{common:.1f}", cells[3], spread, share, seconds])
    head = ["set, object", "photos", "normals (°)", "rotation (°)", "less the ray's turn (°)", "common turn (°)", "less that (°)",
            "focal length, of the reference's", "doubtful", "processor (s)"]  # fmt: skip
    return table(head, body)


def real_photos(rows: list[dict]) -> str:
    body = []
    for row in rows:
        iou = f"{row['silhouette_iou']:.3f}" + (
            f" ({row['reference_iou']:.3f})" if row["reference_iou"] is not None else ""
        )
        degrees = [f"{row[name]:.1f}" for name in ("normal_error_deg", "rotation_error_deg", "about_the_ray_deg")]
        focal = f"{row['focal_ratio']:.2f} ({row['focal_source']})"
        times = f"{row['processor_s']:.0f}, {row['wall_s']:.0f}"
        body.append([f"{row['set']}, {row['photo']}", *degrees, focal, iou, "; ".join(row["doubts"]) or "–", times])
    head = ["photo", "normals (°)", "rotation (°)", "less the ray's turn (°)", "focal length, of the reference's",
            "IoU (the reference's)", "doubts", "processor, wall (s)"]  # fmt: skip
    return table(head, body)


def _of(rows: list[dict], kind: str, shape: str | None) -> list[dict]:
    return [row for row in rows if row["kind"] == kind and shape in (None, row["shape"])]


def _share(flags: Iterable[bool]) -> str:
    """
    >>> _share([True, False]), _share([])
    ('1 of 2', '–')
    """
    flags = list(flags)
    return f"{sum(flags)} of {len(flags)}" if flags else "–"
