"""What a method answers, as what it predicts of photos that were not taken."""

from __future__ import annotations

from typing import Protocol

import msgspec

from factorlib.results.materials import Reflectance
from studies.core.baselines.body import Seen
from studies.core.baselines.scene import Map, Radiance, Scene


class Prediction(Protocol):
    """A method's answer.

    materials: reflectances that it states, by name, in the truth's gauge;  lights: maps that it states, by number, in that gauge
    lambertian: that it states no specular part, rather than none being there
    """

    materials: dict[str, Reflectance]
    lights: dict[int, Map]
    lambertian: bool

    def new_view(self, material: str, light: int, seen: Seen) -> Radiance:
        """A body that was photographed in that light, by another camera."""

    def new_light(self, material: str, light: Map, seen: Seen) -> Radiance:
        """A body that was photographed, in another light, which is given."""

    def new_material(self, material: Reflectance, light: int, seen: Seen) -> Radiance | None:
        """A body of another material, which is given, in the light of a photo; None where the method has nothing to say."""


class Rendered(msgspec.Struct, frozen=True):
    """The answer of a method that finds a reflectance for each material and a map for each light: it is rendered as the truth is."""

    materials: dict[str, Reflectance]
    lights: dict[int, Map]
    lambertian: bool = False

    def new_view(self, material: str, light: int, seen: Seen) -> Radiance:
        """Recovered material, recovered light."""
        return self._scene(light, seen).of(self.materials[material])

    def new_light(self, material: str, light: Map, seen: Seen) -> Radiance:
        """Recovered material, given light."""
        return Scene(light, seen).of(self.materials[material])

    def new_material(self, material: Reflectance, light: int, seen: Seen) -> Radiance | None:
        """Given material, recovered light."""
        return self._scene(light, seen).of(material)

    def _scene(self, light: int, seen: Seen) -> Scene:
        return Scene(self.lights[light], seen)
