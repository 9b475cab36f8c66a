"""How much does rounding decide?  `python -m studies.rounding [size …] [--seeds 2] [--times 3] [--docs]`.

Every radiance of a case is multiplied by 1 + 10⁻⁷ · normal, which is less than a photograph's last bit, and the case is solved again.
Processors and libraries round differently too, so their answers differ by as much.  Cases are full matrices of the studies' worlds, as large
as theirs; one is solved as it is, and `times` times perturbed.  The table has the mean over seeds of the largest difference of any two of these.
"""

from __future__ import annotations

import os
from itertools import combinations
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import msgspec
import numpy as np
import typer

from factorlib.evaluate.ball import Light, light_of_lat_long
from factorlib.runner.project import LIBRARY
from factorlib.stage import Inputs, silent
from factorlib.urm.observations import Observations, write_observations
from studies.conclusion import MEASURES
from studies.measured.tools import exact, refresh, table
from studies.spheres import light_map, materials_of, observations_of
from studies.steps.score import scored
from studies.steps.solve import solved
from studies.study import FULL, Case, full_matrix

DOCS, PLACE = LIBRARY / "docs" / "studies.md", "rounding"
PERTURBED = 1e-7  # of a radiance
NAMES = ("diffuse", "specular", "roughness", "stated_roughness", "entries")  # of measures


def perturbed(table: Observations, rng: np.random.Generator) -> Observations:
    """The same observations, each radiance off by about `PERTURBED` of it."""
    share = 1 + PERTURBED * rng.standard_normal(table.radiance.shape)
    return msgspec.structs.replace(table, radiance=table.radiance * share)


def errors_of(case: Case, lights: dict[int, Light], time: int) -> dict[str, float]:
    """What a solve of the case scores; time: 0 as it is, else the number of the perturbation."""
    truths = materials_of(case.seed)
    with TemporaryDirectory() as folder:
        urm, out = Path(folder) / "urm", Path(folder) / "solve"
        urm.mkdir(), out.mkdir()
        for number, (name, observed) in enumerate(observations_of(case, truths, lights).items()):
            rng = np.random.default_rng([14, case.seed, number, time])
            write_observations(urm / f"{name}.parquet", perturbed(observed, rng) if time else observed)
        solved({}, urm, Inputs({}), out, silent)
        return scored(case, truths, out, lights)[0].values


def row_of(size: int, seeds: int, times: int) -> list[str]:
    """Of the full matrix of `size` materials in as many lights: each measure as it is, and how far solves lie apart."""
    first, apart = [], []
    for seed in range(seeds):
        case = FULL.case(seed, full_matrix(size, size))
        maps = {li: light_map(seed, li, FULL.light_rows, FULL.light_spp) for li in range(size)}
        lights = {li: light_of_lat_long(radiance) for li, radiance in maps.items()}
        solves = [errors_of(case, lights, time) for time in range(times + 1)]
        first.append([solves[0][name] for name in NAMES])
        apart.append([max(abs(a[name] - b[name]) for a, b in combinations(solves, 2)) for name in NAMES])
    means = zip(np.mean(first, axis=0), np.mean(apart, axis=0) / 2, strict=True)
    return [f"{size} × {size}", *(f"{exact(error)}, ± {exact(half)}" for error, half in means)]


def main(
    sizes: Annotated[list[int] | None, typer.Argument(help="materials, and lights; without: 1 2 3")] = None,
    seeds: Annotated[int, typer.Option(min=1, help="worlds")] = 2,
    times: Annotated[int, typer.Option(min=1, help="perturbations of each")] = 3,
    docs: Annotated[bool, typer.Option(help="also refresh the table in docs/studies.md")] = False,
) -> None:
    """Print a row for each size."""
    os.environ["FACTORLIB_MITSUBA"] = "scalar_rgb"  # of the lights, as in studies
    rows = [row_of(size, seeds, times) for size in sizes or (1, 2, 3)]
    head = [f"materials × lights ({seeds} worlds, {times + 1} solves of each)", *(MEASURES[n].label for n in NAMES)]
    print(table(head, rows))
    if docs:
        refresh(DOCS, {PLACE: table(head, rows)})


if __name__ == "__main__":
    typer.run(main)
