"""Unstructured reflectance map: every pixel whose material and normal are known becomes an observation."""

import logging
from pathlib import Path
from typing import Annotated

import msgspec

from factorlib.images.exr import read_exr
from factorlib.stage import Inputs, Progress
from factorlib.urm.extract import observations_of_photo
from factorlib.urm.merge import merge
from factorlib.urm.observations import write_observations

log = logging.getLogger("factorlib.urm")


class Params(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    merge_degrees: Annotated[float, msgspec.Meta(ge=0, le=30)] = 0.0  # 0 keeps every pixel
    least_confidence: Annotated[float, msgspec.Meta(ge=0, lt=1)] = 0.0


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    name = inputs.photo
    light = inputs.facts["dataset.light"]
    observations = observations_of_photo(
        read_exr(inputs["masks"] / f"{name}.exr"),
        read_exr(inputs["align"] / f"{name}.exr"),
        name=name,
        illumination=light["illumination"],
        materials=inputs.facts["dataset.materials"],
        least_confidence=params.least_confidence,
    )
    if len(observations) == 0:
        log.warning("%s: no pixel where mask and mesh agree: the photo tells nothing; see its overlay in align", name)
    write_observations(out / f"{name}.parquet", merge(observations, params.merge_degrees))
