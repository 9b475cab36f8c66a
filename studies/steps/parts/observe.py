"""What the sets' photographs show, by the stages `masks`, `align` and `urm`: writes <seed>/urm/<photo>.parquet."""

from __future__ import annotations

from pathlib import Path

import msgspec

from factorlib.stage import Inputs, Progress
from studies.core.chairs import observe


class Params(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Nothing to choose."""


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Every set."""
    sets = sorted(folder for folder in inputs["sets"].iterdir() if folder.is_dir())
    for number, folder in enumerate(sets):
        progress(number, len(sets), f"set {folder.name}")
        observe(folder, out / folder.name)
