"""Alignment against rendered truth: `make bench-align`, or `python -m benchmarks.align [options]`.

Writes align.json to build/bench/align, after every photo anew, and prints the tables; --docs also refreshes docs/align.md.
The whole set: `python -m benchmarks.align --views 20 --seeds 3 --wrong-views 2`.  Rows of kinds that are not run stay as they
were, so that the kinds can be run one after another; only their doubts are found anew, by today's standards (`--kinds ""`: of all).

`--real FOLDER` aligns real photographs instead, a dataset with reference_poses.json, and writes real.json: see `real`.
"""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Annotated

import typer

from benchmarks.align.cases import RIGHT, WRONG, keys
from benchmarks.align.measure import judged, measured_key
from benchmarks.align.real import measured_photo, real_keys
from benchmarks.align.tables import as_tables, real_tables
from benchmarks.markdown import refresh
from factorlib.errors import InputError, did_you_mean
from factorlib.jsonfile import read_json, write_json

ROOT = Path(__file__).resolve().parents[2]


def main(
    views: Annotated[int, typer.Option(help="photos of each shape and right kind")] = 4,
    seeds: Annotated[int, typer.Option(help="0 to this, less one")] = 1,
    wrong_views: Annotated[int, typer.Option(help="photos of each shape and provoked failure")] = 1,
    kinds: Annotated[str, typer.Option(help=f"of {', '.join(RIGHT + WRONG)}")] = ",".join(RIGHT + WRONG),
    jobs: Annotated[int, typer.Option(help="processes, one thread each")] = 1,
    docs: Annotated[bool, typer.Option(help="also refresh the tables of docs/align.md")] = False,
    out: Annotated[Path, typer.Option(help="folder to write to")] = ROOT / "build" / "bench" / "align",
    real: Annotated[
        list[Path] | None, typer.Option(help="datasets of real photographs with reference_poses.json, instead")
    ] = None,
) -> None:
    if real:
        return real_photos(real, jobs, docs, out)
    chosen = tuple(kind for kind in kinds.split(",") if kind)
    for kind in chosen:
        if kind not in RIGHT + WRONG:
            raise InputError(f"no kind '{kind}'", cure=did_you_mean(kind, RIGHT + WRONG))
    out.mkdir(parents=True, exist_ok=True)
    before = read_json(out / "align.json")["photos"] if (out / "align.json").is_file() else []
    rows = [judged(row) for row in before if row["kind"] not in chosen]
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        for row in pool.map(measured_key, keys(views, seeds, chosen, wrong_views)):
            rows.append(row)
            print(said(row), flush=True)
            write_json(out / "align.json", {"photos": rows})
    write_json(out / "align.json", {"photos": rows})
    publish(as_tables(rows), docs)


def real_photos(folders: list[Path], jobs: int, docs: bool, out: Path) -> None:
    """Sets that are not run stay in real.json as they were."""
    out.mkdir(parents=True, exist_ok=True)
    before = read_json(out / "real.json")["photos"] if (out / "real.json").is_file() else []
    rows = [row for row in before if row["set"] not in {folder.resolve().name for folder in folders}]
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        for some in pool.map(measured_photo, real_keys(folders)):
            rows += some
            for row in some:
                print(real_said(row), flush=True)
            write_json(out / "real.json", {"photos": rows})
    write_json(out / "real.json", {"photos": rows})
    publish(real_tables(rows), docs)


def publish(tables: dict[str, str], docs: bool) -> None:
    for inner in tables.values():
        print(f"\n{inner}")
    if docs:
        refresh(ROOT / "docs" / "align.md", tables)


def real_said(row: dict) -> str:
    errors = f"{row['rotation_error_deg']:.1f}° turned, {row['about_the_ray_deg']:.1f}° less the ray's, normals {row['normal_error_deg']:.1f}°"
    fit = f"focal × {row['focal_ratio']:.2f} ({row['focal_source']}), IoU {row['silhouette_iou']:.3f}, {row['processor_s']:.0f} s"
    return f"{row['set']}/{row['photo']}: {errors}, {fit}; {'; '.join(row['doubts']) or 'no doubt'}"


def said(row: dict) -> str:
    error = f"{row['normal_error_deg']:.2f}° ({row['of_the_mesh_deg']:.2f}° of the mesh), " if "right" in row else ""
    doubted = "; ".join(row["doubts"]) or "no doubt"
    return (
        f"{row['name']}: {error}score {row['score']:.4f}, {row['processor_s']:.1f} s, {row['memory_mb']} MB; {doubted}"
    )


if __name__ == "__main__":
    typer.run(main)
