"""A point of the joint problem: a value for every unknown."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec

from factorlib.model.lights import Light
from factorlib.model.materials import Materials


class Point(msgspec.Struct, frozen=True):
    """The materials of a problem, and one light for each of its blocks, in their order."""

    materials: Materials
    lights: list[Light]

    def restricted(self, lights: Sequence[int]) -> Point:
        """The same materials, with the lights of numbers `lights` alone."""
        return Point(self.materials, [self.lights[k] for k in lights])
