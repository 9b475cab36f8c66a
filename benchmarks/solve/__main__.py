"""Speed against error of the joint solve, as JSON: `make bench-solve` or `python -m benchmarks.solve --sets 3x3,5x5`.

Time is wall time from the observations of all pixels to an answer, their reduction included; errors are measured on all
pixels, not on reduced ones: re-synthesis as PSNR of linear radiance, peak = the photo's 99.9th percentile, no factor at
all; materials after one factor a channel.  All solvers run in one process, one after the other, on `--workers` threads.
"""

from __future__ import annotations

import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from tqdm import tqdm

from benchmarks.solve.sets import Spheres, Truth, observations_of, truth_of, withheld
from factorlib.jsonfile import json_text
from factorlib.reflection import reflection_operator
from factorlib.solve.bundle import Bundle, solve
from factorlib.solve.normal_equations import predicted_radiance
from factorlib.solve.problem import Noise, blocks_of_observations
from factorlib.urm.merge import merge
from factorlib.urm.observations import Observations

OUT = Path("build/bench/solve")
EXACT = Noise(absolute=0.02, relative=0.02)
VARIANTS = {
    "network": ("network", 2.0, Bundle()),
    "network, 96 lobes": ("network", 2.0, Bundle(lobes=96, insert=16, rounds=12)),
    "network, 24 lobes": ("network", 2.0, Bundle(lobes=24)),
    "network, merged at 4°": ("network", 4.0, Bundle()),
    "network, not merged": ("network", 0.0, Bundle()),
    "closed form": ("closed_form", 2.0, Bundle()),
}


def psnr(seen: Observations, blocks, solution, operator, photos) -> dict[int, float]:
    """Of each photo, dB."""
    found = {}
    for block, light in zip(blocks, solution.lights, strict=True):
        predicted = predicted_radiance(block, light, solution.materials, operator) * block.unit
        exact = block.radiance * block.unit
        for k, name in enumerate(block.photos):
            own = block.photo == k
            peak = np.quantile(exact[own], 0.999)
            found[seen.photos.index(name)] = float(10 * np.log10(peak**2 / np.mean((predicted[own] - exact[own]) ** 2)))
    return {photo: found[photo] for photo in photos}


def material_errors(found, truth: Truth) -> dict[str, float]:
    """Relative errors of k_d and k_s after one factor a channel, absolute ones of roughness."""
    factor = (truth.diffuse + truth.specular).sum(0) / (found.diffuse + found.specular).sum(0)
    errors = {
        "diffuse": np.abs(found.diffuse * factor / truth.diffuse - 1),
        "specular": np.abs(found.specular * factor / truth.specular - 1),
        "roughness": np.abs(found.roughness - truth.roughness),
    }
    return {f"{name}_{kind}": float(of(error)) for name, error in errors.items() for kind, of in (("mean", np.mean), ("worst", np.max))}


def run(spheres: Spheres, seen: Observations, withhold: list[int], name: str, workers: int) -> dict:
    """The curve of one variant on one set."""
    operator_name, degrees, bundle = VARIANTS[name]
    operator, truth = reflection_operator(operator_name), truth_of(spheres)
    known = withheld(seen, withhold)
    whole = blocks_of_observations(seen, EXACT, held_out=0.0)
    snapshots, spent = [], 0.0
    start = time.perf_counter()
    blocks = blocks_of_observations(merge(known, degrees), EXACT, held_out=0.1)

    def watch(event, solution) -> None:
        if event.phase == "round" or (event.phase == "polish" and event.iteration % 4 == 3):
            snapshots.append((time.perf_counter() - start, f"{event.phase} {event.round}", solution))

    with ThreadPoolExecutor(workers) as pool:
        joint = solve(blocks, len(seen.materials), operator, bundle, lambda f, items: list(pool.map(f, items)), lambda event: None, watch)
    spent = time.perf_counter() - start
    snapshots.append((spent, "end", joint.solution))
    judge = reflection_operator("network")
    fitted = [p for p in range(len(seen.photos)) if p not in withhold]
    curve = []
    for seconds, phase, solution in snapshots:
        db = psnr(seen, whole, solution, judge, range(len(seen.photos)))
        point = {
            "seconds": round(seconds, 2),
            "phase": phase,
            "mean_db": float(np.mean([db[p] for p in fitted])),
            "worst_db": min(db[p] for p in fitted),
        }
        if withhold:
            point["relit_mean_db"] = float(np.mean([db[p] for p in withhold]))
        curve.append(point | material_errors(solution.materials, truth))
    reached = {str(goal): next((p["seconds"] for p in curve if p["mean_db"] >= goal), None) for goal in (42, 45)}
    lobes = [len(light) for light in joint.solution.lights]
    return {
        "seconds": spent,
        "observations": sum(map(len, blocks)),
        "lobes": lobes,
        "seconds_to_db": reached,
        "photos_db": db,
        "curve": curve,
    }


def main(
    sets: Annotated[str, typer.Option(help="m x i, comma separated")] = "3x3,5x5,1x5,5x1",
    variants: Annotated[str, typer.Option(help="comma separated; all by default")] = "",
    hdr: Annotated[Path | None, typer.Option(help="folder of captured maps (.hdr, .exr) in place of made ones")] = None,
    relight: Annotated[bool, typer.Option(help="withhold the pairs (k, k) and measure them too")] = False,
    workers: int = 2,
) -> None:
    captured = tuple(str(p) for p in sorted(hdr.glob("*.[he][dx]r"))) if hdr else ()
    table = {}
    for text in sets.split(","):
        spheres = Spheres(*map(int, text.split("x")), hdr=captured)
        with tqdm(desc=f"photos of {spheres.name}", total=spheres.materials * spheres.lights, delay=2) as bar:
            seen = observations_of(spheres, lambda done, total, bar=bar: bar.update())
        withhold = [k * spheres.materials + k for k in range(min(spheres.materials, spheres.lights))] if relight else []
        for name in [v.strip() for v in variants.split(";")] if variants else VARIANTS:
            row = table.setdefault(spheres.name, {})[name] = run(spheres, seen, withhold, name, workers)
            end = row["curve"][-1]
            typer.echo(
                f"{spheres.name:>14} {name:24} {row['seconds']:6.1f} s  {end['mean_db']:.1f} dB mean {end['worst_db']:.1f} worst  to 42/45 dB {row['seconds_to_db']['42']}/{row['seconds_to_db']['45']} s  k_d {end['diffuse_mean']:.1%}/{end['diffuse_worst']:.1%} k_s {end['specular_mean']:.1%}/{end['specular_worst']:.1%} roughness {end['roughness_mean']:.4f}/{end['roughness_worst']:.4f}"
                + (f" relit {end['relit_mean_db']:.1f} dB" if withhold else "")
            )
            OUT.mkdir(parents=True, exist_ok=True)
            (OUT / "solve.json").write_text(json_text(table))


if __name__ == "__main__":
    typer.run(main)
