"""An earlier solution from which a solve may start: materials.json, lobes.parquet and exposures.json of a folder."""

from pathlib import Path

import msgspec
import numpy as np

from factorlib.errors import InputError
from factorlib.light.lobes import Lobes
from factorlib.results.lobe_table import read_lobes
from factorlib.results.materials import Channels, MaterialTable, read_exposures, read_materials

FILES = ("materials.json", "lobes.parquet", "exposures.json")
CURE = "name the folder of a result of `solve`, as it was written"


class EarlierSolution(msgspec.Struct, frozen=True):
    """An earlier solution, from which a solve starts.

    Attributes:
        lights: in scene radiance, by illumination
        exposures: factor of each photo on its illumination, per channel
    """

    table: MaterialTable
    lights: dict[str, Lobes]
    exposures: dict[str, Channels]

    @property
    def self_shadowing(self) -> str | None:
        """`on` or `off` as chosen, if both were tried; else None."""
        return _decided(self.table.model.self_shadowing, self.table.model.self_shadowing_chosen_by)

    @property
    def interreflection(self) -> str | None:
        """`on` or `off` as chosen, if both were tried; else None."""
        return _decided(self.table.model.interreflection, self.table.model.interreflection_chosen_by)

    def with_relative_exposures(self, relative: dict[str, float]) -> "EarlierSolution":
        """Return the solution with exposures relative to those that the photos' radiances are divided by."""
        exposures = {p: tuple(e / relative.get(p, 1.0) for e in each) for p, each in self.exposures.items()}
        return msgspec.structs.replace(self, exposures=exposures)


def _decided(accepted: bool, chosen_by: dict[str, float]) -> str | None:
    return ("on" if accepted else "off") if chosen_by.keys() & {"margin", "log_bayes_factor"} else None


def read_earlier_solution(folder: Path) -> EarlierSolution:
    """Read the solution in a folder; InputError for files that the stage `solve` did not write."""
    table, lobes, exposures = (folder / name for name in FILES)
    earlier = EarlierSolution(read_materials(table, CURE), read_lobes(lobes, CURE), read_exposures(exposures, CURE))
    fault = None
    path = lobes
    if set(earlier.table.gauge.component) != set(earlier.table.materials):
        fault = "`gauge.component` does not name the same materials as `materials`"
        path = table
    for name, light in earlier.lights.items():
        finite = all(np.isfinite(part).all() for part in (light.axis, light.sharpness, light.weight))
        shaped = (light.sharpness > 0).all() and (np.linalg.norm(light.axis, axis=1) > 0.5).all()
        if not (finite and shaped and (light.weight >= 0).all()):
            fault = f"a lobe of illumination '{name}' is not finite, is negative, or has no axis"
    if fault:
        raise InputError(f"no solution to start from: {fault}", file=path, cure=CURE)
    return earlier
