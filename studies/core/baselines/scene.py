"""Radiance of the body in a light, seen by a camera: by quadrature of the light's map (`factorlib.evaluate.ball`), as spheres are in other studies.

A light is a lat-long map in the photo's light frame, fixed to the body: for a camera that went around both, it is turned into the
camera's own frame.  Truth and answers go through the same turn.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
from jaxtyping import Float

from factorlib.evaluate.ball import diffuse_ball, glossy_ball, light_of_lat_long
from factorlib.light.latlong import turned_map
from factorlib.results.materials import Reflectance
from studies.core.baselines.body import Seen

FINER = 2  # samples along a texel's side where a map is turned
Map = Float[np.ndarray, "h w 3"]
Radiance = Float[np.ndarray, "n 3"]


class Scene:
    """The body in one light, seen by one camera: each part of the reflection is rendered once."""

    def __init__(self, light: Map, seen: Seen):
        ahead = np.array_equal(seen.turn, np.eye(3))
        self.seen, self.light = seen, light_of_lat_long(light if ahead else turned_map(light, seen.turn, FINER))
        self._glossy: dict[float, Radiance] = {}

    @cached_property
    def diffuse(self) -> Radiance:
        """Of white Lambert."""
        return diffuse_ball(self.light, self.seen.normals_in_view)

    def glossy(self, roughness: float) -> Radiance:
        """Of GGX with k_s = 1."""
        if roughness not in self._glossy:
            self._glossy[roughness] = glossy_ball(self.light, self.seen.normals_in_view, roughness)
        return self._glossy[roughness]

    def of(self, material: Reflectance) -> Radiance:
        """Of a material."""
        value = np.asarray(material.diffuse) * self.diffuse
        return (
            value + np.asarray(material.specular) * self.glossy(material.roughness) if any(material.specular) else value
        )
