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

from benchmarks.tools import exact, refresh, table
from factorlib.dataset.schema import LightSlice
from factorlib.evaluate.ball import Light
from factorlib.reflection.network import SHIPPED
from factorlib.runner.project import LIBRARY
from factorlib.stage import Inputs, silent
from factorlib.urm.observations import Observations, write_observations
from stages import solve
from studies.core.case import Case, light_name
from studies.core.observed import observations_of
from studies.core.score import scored
from studies.core.study import FULL, full_matrix
from studies.core.world import light, light_map, materials_of

DOCS = LIBRARY / "docs" / "studies.md"
PLACE = "rounding"
PERTURBED = 1e-7  # of a radiance
MEASURES = {
    "diffuse": "error of k_d",
    "specular": "error of k_s",
    "roughness": "error of roughness",
    "stated_roughness": "its stated standard error",
    "entries": "DSSIM, all entries",
}


def perturbed(seen: Observations, rng: np.random.Generator) -> Observations:
    """The same observations, each radiance off by about `PERTURBED` of it."""
    return msgspec.structs.replace(
        seen, radiance=seen.radiance * (1 + PERTURBED * rng.standard_normal(seen.radiance.shape))
    )


def errors_of(case: Case, lights: dict[int, Light], time: int) -> dict[str, float]:
    """What a solve of the case scores; time: 0 as it is, else the number of the perturbation."""
    truths = materials_of(case.seed)
    with TemporaryDirectory() as folder:
        urm, out = Path(folder) / "urm", Path(folder) / "solve"
        urm.mkdir(), out.mkdir()
        for number, (name, seen) in enumerate(observations_of(case, truths, lights).items()):
            rng = np.random.default_rng([14, case.seed, number, time])
            write_observations(urm / f"{name}.parquet", perturbed(seen, rng) if time else seen)
        facts = {light_name(li): msgspec.to_builtins(LightSlice(light_name(li), None)) for li in case.lights}
        folders = {"urm": urm, "train": SHIPPED}
        solve.main(
            solve.Params(),
            Inputs(folders, {"dataset.materials": case.material_names, "dataset.light": facts}),
            out,
            silent,
        )
        return scored(case, truths, out, lights).score.values


def row_of(size: int, seeds: int, times: int) -> list[str]:
    """Of the full matrix of `size` materials in as many lights: each measure as it is, and how far solves lie apart."""
    first, apart = [], []
    for seed in range(seeds):
        case = FULL.case(seed, full_matrix(size, size))
        lights = {li: light(light_map(seed, li, FULL.light_rows, FULL.light_spp)) for li in range(size)}
        found = [errors_of(case, lights, time) for time in range(times + 1)]
        first.append(found[0])
        apart.append({name: max(abs(a[name] - b[name]) for a, b in combinations(found, 2)) for name in MEASURES})
    means = [[float(np.mean([one[name] for one in of])) for of in (first, apart)] for name in MEASURES]
    return [f"{size} × {size}", *(f"{exact(error)}, ± {exact(difference / 2)}" for error, difference in means)]


def main(
    sizes: Annotated[list[int] | None, typer.Argument(help="materials, and lights; without: 1 2 3")] = None,
    seeds: Annotated[int, typer.Option(min=1, help="worlds")] = 2,
    times: Annotated[int, typer.Option(min=1, help="perturbations of each")] = 3,
    docs: Annotated[bool, typer.Option(help="also refresh the table in docs/studies.md")] = False,
) -> None:
    """Print a row for each size."""
    os.environ["FACTORLIB_MITSUBA"] = "scalar_rgb"  # of the lights, as in studies
    rows = [row_of(size, seeds, times) for size in sizes or (1, 2, 3)]
    found = table([f"materials × lights ({seeds} worlds, {times + 1} solves of each)", *MEASURES.values()], rows)
    print(found)
    if docs:
        refresh(DOCS, {PLACE: found})


if __name__ == "__main__":
    typer.run(main)
