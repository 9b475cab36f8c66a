"""The light of a photo, as pictures are made in it."""

import logging
from pathlib import Path

import numpy as np

from factorlib.dataset.schema import LightSlice
from factorlib.light.lobes import Lobes
from factorlib.results.lobes import read_lobes
from factorlib.results.materials import read_exposures

log = logging.getLogger("factorlib.render")


def light_of(exported: Path, photo: str, light: LightSlice) -> Lobes:
    """The light of a photo as pictures are made in it: lobes in the photo's own camera axes, its exposure included.

    exported: the folder of `export`'s result, whose gauge the light is in
    """
    lobes = read_lobes(exported / "lobes.parquet")[light.illumination]
    if len(lobes) == 0:
        log.warning("%s: nothing is known of its light: its pictures are black", photo)
    if light.world_from_camera is not None:
        lobes = lobes.turned(np.array(light.world_from_camera).T)
    return lobes.scaled(np.array(read_exposures(exported / "exposures.json").get(photo, 1.0)))
