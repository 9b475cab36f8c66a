"""What is photographed: the body, of each material that a light shows, with noise; as the observations that the stage `urm` writes.

A photo, one a light, shows its bodies side by side, all turned alike.  Noise: each radiance times 1 + .01 · normal.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

import msgspec
import numpy as np

from factorlib.conventions import FRONT
from factorlib.results.materials import Reflectance
from factorlib.urm.observations import Observations, read_observations
from studies.core.baselines.body import Seen, seen
from studies.core.baselines.case import Comparison
from studies.core.baselines.scene import Map, Radiance, Scene
from studies.core.case import light_name
from studies.core.observed import NOISE
from studies.core.world import in_camera


class Photos(msgspec.Struct, frozen=True):
    """What all methods see: the body as the photos' camera sees it, and its radiance there by material's name and light."""

    seen: Seen
    radiance: dict[tuple[str, int], Radiance]

    @property
    def materials(self) -> list[str]:
        """By name, in order of their first photo."""
        return list(dict.fromkeys(name for name, _ in self.radiance))

    @property
    def lights(self) -> list[int]:
        """By number."""
        return sorted({light for _, light in self.radiance})


def photographed(case: Comparison, materials: Mapping[str, Reflectance], lights: Mapping[int, Map]) -> Photos:
    """Render the entries of a case."""
    camera, named = seen(case.seed, case.size), list(materials.items())
    scenes = {li: Scene(lights[li], camera) for li in case.lights}
    shown = {}
    for m, li in case.entries:
        name, material = named[m]
        exact = scenes[li].of(material)
        shown[name, li] = exact * (
            1 + NOISE * np.random.default_rng([15, case.seed, li, m]).standard_normal(exact.shape)
        )
    return Photos(camera, shown)


def observations_of(case: Comparison, photos: Photos) -> dict[str, Observations]:
    """One table a light, by the photo's name."""
    return {light_name(li): _of_light(case, photos, li) for li in case.lights}


def _of_light(case: Comparison, photos: Photos, light: int) -> Observations:
    names = [name for name, li in photos.radiance if li == light]
    normals, (y, x) = in_camera(photos.seen.normals), np.nonzero(photos.seen.inside)
    each, n = len(normals), len(normals) * len(names)
    zero, photo = np.zeros(n, int), (light_name(light),)
    return Observations(
        normal=np.tile(normals, (len(names), 1)), view=np.tile(FRONT, (n, 1)), radiance=np.concatenate([photos.radiance[m, light] for m in names]),
        clipped=np.zeros((n, 3), bool), material=np.repeat([case.material_names.index(m) for m in names], each), photo=zero, illumination=zero,
        x=np.concatenate([x + case.size * k for k in range(len(names))]), y=np.tile(y, len(names)), weight=np.ones(n),
        materials=tuple(case.material_names), photos=photo, illuminations=photo,
    )  # fmt: skip


def read_photos(case: Comparison, folder: Path) -> Photos:
    """What `observations_of` was written to, a file a light."""
    tables = {li: read_observations(folder / f"{light_name(li)}.parquet") for li in case.lights}
    return Photos(seen(case.seed, case.size), dict(_entries(tables)))


def _entries(tables: Mapping[int, Observations]) -> Iterable[tuple[tuple[str, int], Radiance]]:
    for light, table in tables.items():
        for number in np.unique(table.material):
            yield (table.materials[number], light), table.radiance[table.material == number].astype(float)
