"""Lights of all worlds that a study uses: writes <seed>-<light>.exr, lat-long, mean radiance 1.

Mitsuba's scalar variant traces, which every machine has: the faster one gives other noise, and so other worlds.
"""

import os
from pathlib import Path

import msgspec

from factorlib.images.exr import LAT_LONG, write_rgb_exr
from factorlib.stage import Inputs, Progress
from studies.spheres import light_map
from studies.steps import Params
from studies.study import World


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Render and write the map of every light."""
    os.environ["FACTORLIB_MITSUBA"] = "scalar_rgb"  # read where Mitsuba is first used
    world = msgspec.convert(inputs.facts["dataset.worlds"], World)
    lights = [(seed, light) for seed in world.seeds for light in range(world.lights)]
    for number, (seed, light) in enumerate(lights):
        progress(number, len(lights), f"light {light} of seed {seed}")
        write_rgb_exr(out / f"{seed}-{light}.exr", light_map(seed, light, world.rows, world.spp), LAT_LONG)
