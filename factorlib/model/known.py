"""What is known beforehand: unknowns of materials and lights that are held at their values while all others are found.

A known reflectance settles the factor per channel that is otherwise free in its connected component (`factorlib.model.gauge`): scale and
white balance come from it.  So does a known light, unless its radiance is known but for one factor: then white balance alone comes from it.
Held unknowns have no rows and columns in the solver's system.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Literal

import msgspec
import numpy as np
from jaxtyping import Bool, Float

from factorlib.model.lights import Light
from factorlib.model.materials import Materials


class Known(msgspec.Struct, frozen=True):
    """materials: k_d, k_s (RGB each) and roughness by a material's number, NaN where it is not known.

    lights: by illumination, in the radiance of its photos, with the cells that are known (`Light.held`)
    exposures: illuminations whose photos' exposures are known: radiance has been divided by them
    """

    materials: dict[int, Float[np.ndarray, "7"]] = {}
    lights: dict[str, Light] = {}
    exposures: tuple[str, ...] = ()

    @property
    def nothing(self) -> bool:
        """Whether everything is to be found."""
        return not (self.materials or self.lights or self.exposures)

    def put(self, materials: Materials) -> Materials:
        """The materials with what is known in its place."""
        if not self.materials:
            return materials
        rows = materials.rows()
        for m, values in self.materials.items():
            rows[m] = np.where(np.isnan(values), rows[m], values)
        return Materials.of_rows(rows)

    def free(self, count: int) -> Bool[np.ndarray, " 7m"]:
        """Which unknowns of `count` materials are to be found."""
        free = np.ones((count, 7), bool)
        for m, values in self.materials.items():
            free[m] = np.isnan(values)
        return free.reshape(-1)

    def factors(self, members: Iterable[int], illuminations: Iterable[str]) -> Literal[0, 1, 3]:
        """How many factors stay free between the reflectances and the lights of a component: one a channel, one for all, or none."""
        lights = [self.lights[name] for name in illuminations if name in self.lights]
        if self.of(members) or not all(light.scale_free for light in lights):
            return 0
        return 1 if lights else 3

    def of(self, members: Iterable[int]) -> list[int]:
        """The known ones of some materials."""
        return [m for m in members if m in self.materials]
