"""The lights of all worlds that a study shows: writes <seed>-<light>.exr, lat-long, mean radiance 1.

A light that is done outlives a kill of the step.  Mitsuba's scalar variant traces, which every machine has: the faster one gives
other noise, and so other worlds.
"""

from __future__ import annotations

import os
from pathlib import Path

import msgspec

from factorlib.images.exr import LAT_LONG, write_rgb_exr
from factorlib.stage import Inputs, Progress
from factorlib.wholefile import replace_file
from studies.spheres import light_file, light_map
from studies.steps import Params
from studies.study import World


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Trace every light that is not there yet."""
    os.environ["FACTORLIB_MITSUBA"] = "scalar_rgb"  # read where Mitsuba is first used
    world = msgspec.convert(inputs.facts["dataset.worlds"], World)
    wanted = [(seed, light) for seed in world.seeds for light in range(world.lights)]
    kept = inputs.unfinished or out
    kept.mkdir(parents=True, exist_ok=True)
    for number, (seed, light) in enumerate(wanted):
        progress(number, len(wanted), f"light {light} of seed {seed}")
        file = kept / light_file(seed, light)
        if not file.exists():
            write_rgb_exr(draft := kept / "draft.exr", light_map(seed, light, world.rows, world.spp), LAT_LONG)
            draft.rename(file)
        if kept != out:
            replace_file(out / file.name, file.read_bytes())
