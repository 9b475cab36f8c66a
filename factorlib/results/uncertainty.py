"""uncertainty.json of `solve`: standard errors of the materials, and how well the observations are explained."""

from __future__ import annotations

from pathlib import Path

import msgspec

from factorlib.jsonfile import write_json
from factorlib.results.file import read_result
from factorlib.results.materials import AtLeast0, StandardErrors


class Uncertainty(msgspec.Struct, frozen=True):
    """residual_sigma: deviation of the residuals in units of the noise model;  materials: by name;  gauge: of the standard errors."""

    residual_sigma: AtLeast0
    materials: dict[str, StandardErrors]
    gauge: str


def write_uncertainty(path: str | Path, uncertainty: Uncertainty) -> None:
    """Write uncertainty.json."""
    write_json(path, uncertainty)


def read_uncertainty(path: str | Path) -> Uncertainty:
    """Raises InputError for a file that is none."""
    return read_result(path, Uncertainty, "solve")
