"""Speed against error of the joint solve: `make bench-solve`, or `python -m benchmarks.solve [options]`.

One process runs every solver on every set in turn, each on all processors, so that ratios of times hold.  Writes solve.json,
after every solver anew, and error_over_time.svg to build/bench/solve; the traced sets are kept in build/bench/sets.
What solve.json there holds of other sets and solvers stays; --docs writes all of it to docs/solve-speed.md.
The operator `reference` is left out: it takes hours.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import torch
import typer

from benchmarks.markdown import refresh
from benchmarks.solve import bundle, joint_mitsuba, paper, scaling
from benchmarks.solve.figures import error_over_time
from benchmarks.solve.sets import SETS, SphereSet, sphere_set
from benchmarks.solve.tables import as_tables
from factorlib.errors import InputError, did_you_mean
from factorlib.jsonfile import read_json, write_json

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
SOLVERS = ("bundle", "variants", "paper", "mitsuba", "scaling")
MITSUBA_SETS = ("3x3",)


def labelled(solver: str, spheres: SphereSet, limit_s: float, share: float, relight: bool):
    """(label, row) of each run of the solver on the set."""
    if solver == "bundle":
        yield bundle.DEFAULT.name, bundle.run(spheres, bundle.DEFAULT, relight)
    if solver == "variants":
        for variant in bundle.VARIANTS[1:]:
            yield variant.name, bundle.run(spheres, variant, relight=False)
    if solver == "paper":
        for operator in paper.OPERATORS:
            yield f"paper, {operator}", paper.run(spheres, operator, share, relight and operator == paper.OPERATORS[0])
    if solver == "mitsuba" and spheres.name in MITSUBA_SETS:
        yield "mitsuba", joint_mitsuba.run(spheres, limit_s)


def about(spheres: SphereSet) -> dict:
    noise = [pair.noise_db for pair in spheres.pairs.values()]
    held_back = [" ".join(pair) for pair in sorted(spheres.held_back())]
    return {"pairs": len(noise), "worst_noise_db": min(noise), "held_back": held_back, "solvers": {}}


def names_of(listed: str, known) -> list[str]:
    names = [name for name in listed.split(",") if name]
    for name in names:
        if name not in known:
            raise InputError(f"no '{name}'", cure=did_you_mean(name, known))
    return names


def main(
    sets: Annotated[str, typer.Option(help=f"of {', '.join(SETS)}")] = "3x3,5x5,1x5,5x1",
    solvers: Annotated[str, typer.Option(help=f"of {', '.join(SOLVERS)}")] = ",".join(SOLVERS),
    hdr: Annotated[Path | None, typer.Option(help="folder of lat-long maps to light the spheres with")] = None,
    limit_s: Annotated[float, typer.Option(help="wall time of all of Mitsuba's learning rates, and of scaling")] = 900.0,
    share: Annotated[float, typer.Option(help="of the observations that the paper's solver is given")] = 1.0,
    relight: Annotated[bool, typer.Option(help="solve once more with pairs held back")] = True,
    out: Annotated[Path, typer.Option(help="folder to write to")] = ROOT / "build" / "bench" / "solve",
    docs: Annotated[bool, typer.Option(help="also refresh docs/solve-speed.md")] = False,
) -> None:
    torch.set_num_threads(1)
    chosen, before = names_of(solvers, SOLVERS), out / "solve.json"
    out.mkdir(parents=True, exist_ok=True)
    result = read_json(before) if before.exists() else {"sets": {}}
    for name in names_of(sets, SETS):
        spheres = sphere_set(name, ROOT / "build" / "bench" / "sets", hdr)
        table = result["sets"].setdefault(name, about(spheres))
        for solver in chosen:
            for label, row in labelled(solver, spheres, limit_s, share, relight):
                table["solvers"][label] = row
                write(out, result)
                print(said(name, label, row), flush=True)
    if "scaling" in chosen:
        result["scaling"] = scaling.run(limit_s=limit_s)
        write(out, result)
        print(f"scaling: {result['scaling']}")
    if docs:
        refresh(DOCS / "solve-speed.md", as_tables(result))
        (DOCS / "solve").mkdir(exist_ok=True)
        (DOCS / "solve" / "error_over_time.svg").write_text(error_over_time(shown_in(result)), encoding="utf-8")


def write(out: Path, result: dict) -> None:
    write_json(out / "solve.json", result)
    if shown := shown_in(result):
        (out / "error_over_time.svg").write_text(error_over_time(shown), encoding="utf-8")


def shown_in(result: dict) -> dict:
    return {name: table for name, table in result["sets"].items() if table["solvers"]}


def said(name: str, label: str, row: dict) -> str:
    """One line of a run."""
    psnr, materials, last = row["resynthesis"]["psnr"], row["materials"], row["points"][-1]
    errors = f"k_d {materials['diffuse']['mean']:.1%}, k_s {materials['specular']['mean']:.1%}, roughness {materials['roughness']['mean']:.4f}"
    relit = f"; relit {row['relighting']['psnr']['mean']:.1f} dB" if "relighting" in row else ""
    times = f"{last['wall']:.0f} s ({last['processor']:.0f} s of processor)"
    return f"{name} {label}: {times}, {psnr['mean']:.1f} dB, worst {psnr['worst']:.1f} dB ({psnr['worst_pair']}); {errors}{relit}"


if __name__ == "__main__":
    typer.run(main)
