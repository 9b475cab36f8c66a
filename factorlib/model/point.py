"""A point of the joint problem: a value for every unknown."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import numpy as np
from jaxtyping import Float

from factorlib.model.lights import Light
from factorlib.model.materials import Materials


class Point(msgspec.Struct, frozen=True):
    """The materials of a problem, and one light for each of its blocks, in their order."""

    materials: Materials
    lights: list[Light]

    def moved(self, by_materials: Float[np.ndarray, " 7m"], by_lights: Sequence[Float[np.ndarray, " l"]]) -> Point:
        """The nearest point within bounds after a step in all unknowns."""
        blur = self.materials.blur
        lights = [light.moved(by, blur) for light, by in zip(self.lights, by_lights, strict=True)]
        return Point(Materials.of_vector(self.materials.vector() + by_materials), lights)

    def restricted(self, lights: Sequence[int]) -> Point:
        """The same materials, with the lights of numbers `lights` alone."""
        return Point(self.materials, [self.lights[k] for k in lights])
