"""The lights of the worlds, one more for each seed than spheres have: writes <seed>-<light>.exr."""

from __future__ import annotations

from pathlib import Path

import msgspec

from factorlib.stage import Inputs, Progress
from studies.core.case import World
from studies.core.objects.world import with_one_light_more
from studies.steps.spheres import worlds
from studies.steps.spheres.worlds import Params


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Trace every light that is not there yet."""
    world = with_one_light_more(msgspec.convert(inputs.facts["dataset.worlds"], World))
    facts = {**inputs.facts, "dataset.worlds": msgspec.to_builtins(world)}
    worlds.main(params, msgspec.structs.replace(inputs, facts=facts), out, progress)
