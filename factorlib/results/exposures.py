"""exposures.json of `solve` and `export`: what each photo's light is multiplied by, per channel."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from factorlib.errors import InputError
from factorlib.jsonfile import write_json
from factorlib.results.file import read_result
from factorlib.results.materials import Channels


def write_exposures(path: str | Path, exposures: Mapping[str, Channels]) -> None:
    """Write factors by photo."""
    write_json(path, exposures)


def read_exposures(path: str | Path, cure: str = "") -> dict[str, Channels]:
    """Factors by photo, all positive; raises InputError for a file that is none."""
    exposures = read_result(path, dict[str, Channels], "solve", cure)
    for photo, channels in exposures.items():
        if min(channels) <= 0:
            cure = cure or "run the stage `solve` again"
            raise InputError("an exposure is not a positive number", file=path, key=photo, cure=cure)
    return exposures
