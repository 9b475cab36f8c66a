"""Meshes with wrong proportions: `python -m benchmarks.proportions [--photos 4 --shape chair,jug --off 1,1.1,1.15]`.

Photos of a shape of `benchmarks.align.shapes`, with a mesh of that shape, one axis of which is too long.  Poses and focal lengths are searched
with the wrong mesh, as `align` does; then factors are fitted, as `fit_mesh` does.
"""

from __future__ import annotations

import time
import zlib
from pathlib import Path

import numpy as np
import typer

from benchmarks.align import shapes
from benchmarks.align.cases import FILLS, photographed
from factorlib.align.proportions import Sighting, proportions
from factorlib.align.search import find, focal_prior
from factorlib.align.silhouette import Silhouette
from factorlib.align.state import State
from factorlib.align.target import target_of
from factorlib.geometry.camera import Camera, Pose
from factorlib.geometry.raster import Caster, rasterise
from factorlib.jsonfile import write_json
from factorlib.meshes.mesh import Mesh, scaled


def measured(shape: str, axis: int, off: float, photos: int, rough: bool = False) -> dict:
    """Largest error of a factor, in per cent, and the normals' median errors in each photo before and after, degrees."""
    rng = np.random.default_rng(zlib.crc32(f"{shape} {axis} {off} {rough}".encode()))
    factors = np.ones(3)
    factors[axis] = off
    true = shapes.mesh(shape)
    given = scaled(shapes.rough(shape, 0) if rough else true, factors)
    caster, sightings, truth = Caster(given), [], []
    for _ in range(photos):
        camera, pose, label = photographed(true, rng, rng.uniform(*FILLS))
        silhouette, prior = Silhouette(label.astype(np.int16)), focal_prior(None, None, camera.width, camera.height)
        found = find(caster, silhouette, camera, prior)
        sightings.append(
            Sighting(
                given, target_of(silhouette, given.labels, 200, 0.15), found.state.camera(camera), prior, found.state
            )
        )
        truth.append((camera, pose))
    start = time.perf_counter()
    verdict = proportions(sightings)
    seconds = time.perf_counter() - start
    wanted = 1 / factors / (1 / factors).prod() ** (1 / 3)

    def errors(mesh: Mesh, states: list[State]) -> list[float]:
        return [
            normal_error(true, *posed, mesh, one.camera, state)
            for posed, one, state in zip(truth, sightings, states, strict=True)
        ]

    return {
        "shape": shape, "axis": axis, "off": off, "rough": rough, "used": verdict.used, "seconds": seconds,
        "factors": verdict.fitted.factors.tolist(), "error_percent": float(100 * np.abs(verdict.fitted.factors / wanted - 1).max()),
        "held_out": [verdict.held_out_before, verdict.held_out_after],
        "before": errors(given, [one.state for one in sightings]),
        "after": errors(scaled(given, verdict.fitted.factors), verdict.fitted.states),
    }  # fmt: skip


def normal_error(true: Mesh, camera: Camera, pose: Pose, mesh: Mesh, found: Camera, state: State) -> float:
    """Median over the true silhouette; a pixel that the found pose misses counts as 180°."""
    there, seen = rasterise(true, camera, pose), rasterise(mesh, state.camera(found), state.pose(mesh))
    angle = np.rad2deg(np.arccos(np.clip(np.sum(there.normal * seen.normal, axis=-1), -1, 1)))
    return float(np.median(np.where(seen.label > 0, angle, 180.0)[there.label > 0]))


def table(rows: list[dict]) -> str:
    lines = [
        "| shape | axis times | used | factors off by at most (%) | normal error before: median, worst (°) | after (°) | s |",
        "|---|---:|---|---:|---:|---:|---:|",
    ]
    for row in rows:
        before, after = np.array(row["before"]), np.array(row["after"])
        name = row["shape"] + (", rough" if row["rough"] else "")
        lines.append(
            f"| {name} | {row['off']:.3g} | {'yes' if row['used'] else 'no'} | {row['error_percent']:.2g} | {np.median(before):.2g}, {before.max():.2g} "
            f"| {np.median(after):.2g}, {after.max():.2g} | {row['seconds']:.2g} |"
        )
    return "\n".join(lines)


def main(
    photos: int = 4,
    shape: str = ",".join(shapes.SHAPES),
    off: str = "1,1.1,1.15",
    rough: bool = False,
    out: Path = Path("build/bench/proportions"),
) -> None:
    rows = []
    for number, name in enumerate(shape.split(",")):
        for times in map(float, off.split(",")):
            rows.append(measured(name, number % 3, times, photos, rough))
            print(rows[-1], flush=True)
    out.mkdir(parents=True, exist_ok=True)
    write_json(out / f"rows{'_rough' if rough else ''}.json", rows)
    print(table(rows))


if __name__ == "__main__":
    typer.run(main)
