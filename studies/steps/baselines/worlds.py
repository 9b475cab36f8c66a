"""The lights of all worlds that the studies of a scale show, as for spheres: writes <seed>-<light>.exr."""

from __future__ import annotations

from pathlib import Path

import msgspec

from factorlib.stage import Inputs, Progress
from studies.steps.spheres import worlds


class Params(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Nothing to choose: the scale says all."""


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Trace every light that is not there yet."""
    worlds.main(worlds.Params(), inputs, out, progress)
