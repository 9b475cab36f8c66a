"""An earlier solution: materials.json, lobes.parquet and exposures.json of a folder, by the names they have there."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np

from factorlib.errors import InputError
from factorlib.jsonfile import read_json
from factorlib.light.lobes import Lobes, read_lobes
from factorlib.model.bounds import TONE

FILES = ("materials.json", "lobes.parquet", "exposures.json")
AT_LEAST_0 = Annotated[float, msgspec.Meta(ge=0)]
Channels = tuple[AT_LEAST_0, AT_LEAST_0, AT_LEAST_0]


class Reflectance(msgspec.Struct, frozen=True):
    """One material of materials.json."""

    diffuse: Channels
    specular: Channels
    roughness: Annotated[float, msgspec.Meta(ge=0, le=1)]


class Gauge(msgspec.Struct, frozen=True):
    """component: number of each material's connected component; a factor per channel is free in each."""

    component: dict[str, int]


class Tone(msgspec.Struct, frozen=True):
    """The tone curve of a photo (`factorlib.images.tone`); pivot is the radiance that it leaves as it is."""

    exponent: Annotated[float, msgspec.Meta(ge=TONE[0], le=TONE[1])]
    pivot: Annotated[float, msgspec.Meta(gt=0)]


class Model(msgspec.Struct, frozen=True):
    """What was decided; self_shadowing_chosen_by holds the loss of each model that was tried, tone the photos that have a curve."""

    specular: dict[str, bool] = {}
    self_shadowing: bool = False
    self_shadowing_chosen_by: dict[str, float] = {}
    tone: dict[str, Tone] = {}


class Table(msgspec.Struct, frozen=True):
    """What is used of materials.json."""

    materials: dict[str, Reflectance]
    gauge: Gauge
    model: Model = Model()


class Earlier(msgspec.Struct, frozen=True):
    """lights: in scene radiance, by illumination;  exposures: factor of each photo on its illumination, per channel."""

    table: Table
    lights: dict[str, Lobes]
    exposures: dict[str, Channels]

    @property
    def self_shadowing(self) -> str | None:
        """`on` or `off`, as it was decided, where both were tried; else None."""
        return ("on" if self.table.model.self_shadowing else "off") if len(self.table.model.self_shadowing_chosen_by) == 2 else None


def read_earlier(folder: Path) -> Earlier:
    """Raises InputError for files that the stage `solve` did not write."""
    table, lobes, exposures = (folder / name for name in FILES)
    earlier = Earlier(_of_json(table, Table), read_lobes(lobes), _of_json(exposures, dict[str, Channels]))
    numbers = [[*m.diffuse, *m.specular, m.roughness] for m in earlier.table.materials.values()]
    _check(np.isfinite(np.array(numbers)).all(), table, "a reflectance is not finite")
    _check(set(earlier.table.gauge.component) == set(earlier.table.materials), table, "`gauge.component` names other materials")
    _check(all(np.isfinite(v).all() and min(v) > 0 for v in earlier.exposures.values()), exposures, "an exposure is not a positive number")
    for name, light in earlier.lights.items():
        finite = all(np.isfinite(part).all() for part in (light.axis, light.sharpness, light.weight))
        good = finite and (light.weight >= 0).all() and (light.sharpness > 0).all() and (np.linalg.norm(light.axis, axis=1) > 0.5).all()
        _check(good, lobes, f"illumination '{name}' has a lobe that is none: not finite, negative, or without axis")
    return earlier


def _of_json(path: Path, type_: Any) -> Any:
    try:
        return msgspec.convert(read_json(path), type_)
    except msgspec.ValidationError as error:
        raise _unfit(path, str(error)) from None


def _check(good: bool, path: Path, found: str) -> None:
    if not good:
        raise _unfit(path, found)


def _unfit(path: Path, found: str) -> InputError:
    return InputError(
        f"no earlier solution to start from: {found}", file=path, cure="name the folder of a result of `solve`, as it was written"
    )
