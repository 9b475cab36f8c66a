"""At which rate does Mitsuba's joint optimisation do best?  `python -m studies.joint_rate [rate …] [--seed 100] [--side 2]`.

On a seed that no study reports, with pictures as large as the full study's, each rate until its loss is flat.  The best, by the mean of its last losses, is
`studies.core.baselines.joint.RATE`.
"""

from __future__ import annotations

import os
import sys
from typing import Annotated

import msgspec
import numpy as np
import typer

from benchmarks.tools import table
from factorlib.errors import InputError
from studies.catalogue.contents import STUDIES
from studies.core.baselines.adam import FLAT
from studies.core.baselines.joint import RATES, Optimised, optimised
from studies.core.baselines.photos import photographed
from studies.core.study import FULL
from studies.core.world import light_map, materials_of


def tried(seed: int, side: int, rate: float) -> Optimised:
    """Where a rate ends on the photos of a seed, of `side` materials in as many lights."""
    scale = msgspec.structs.replace(FULL, side=side)
    setting = next(s for s in STUDIES["comparison"].settings(scale) if s.name == "mitsuba")
    case = setting.case(seed)
    lights = {li: light_map(seed, li, FULL.light_rows, FULL.light_spp) for li in case.lights}
    return optimised(seed, photographed(case, materials_of(seed), lights), case.joint, rate)


def main(
    rates: Annotated[list[float] | None, typer.Argument(help="all that are compared without it")] = None,
    seed: Annotated[int, typer.Option(help="not one of those that are reported")] = 100,
    side: Annotated[int, typer.Option(min=1, max=FULL.largest, help="materials, and lights")] = FULL.side,
) -> None:
    """Print a row for each rate."""
    if seed in FULL.seeds:
        sys.exit(f"error: {InputError(f'seed {seed} is reported', key='--seed', cure='choose on another one')}")
    os.environ["FACTORLIB_MITSUBA"] = "scalar_rgb"  # of the lights, as in studies
    rows = []
    for rate in rates or RATES:
        found = tried(seed, side, rate)
        numbers = (
            f"{np.mean(found.losses[-FLAT:]):.3g}",
            str(len(found.losses)),
            "yes" if found.flat else "no",
            f"{found.processor:.0f}",
        )
        rows.append([f"{rate:g}", *numbers])
    print(table(["rate", "loss at the end", "steps", "flat", "processor, s"], rows))


if __name__ == "__main__":
    typer.run(main)
