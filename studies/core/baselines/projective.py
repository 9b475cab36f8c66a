"""Projective texturing: the photo's pixels are stuck on the body and carried to the new view.

It knows the body and the camera.  A point that the photo saw has the photo's colour there, between pixels by inverse distance.
One that it did not see has the colour of the seen point whose normal is nearest, `NEAREST` of them averaged so that no
streaks appear.  A new light changes nothing: the colours are the mean of the textures of all photos of the material.
"""

from __future__ import annotations

import msgspec
import numpy as np
from scipy.spatial import cKDTree

from factorlib.results.materials import Reflectance
from studies.core.baselines.body import Seen
from studies.core.baselines.photos import Photos
from studies.core.baselines.scene import Map, Radiance

BETWEEN = 4  # pixels of the photo that a point is between
NEAREST = 12  # pixels that a point takes its colour from which no photo shows


class Texture:
    """Values at the points that a photo sees, to be read from other views."""

    def __init__(self, photo: Seen):
        self.photo = photo
        self._points, self._normals = cKDTree(photo.points), cKDTree(photo.normals)

    def seen(self, view: Seen) -> np.ndarray:
        """Which of a view's points the photo sees, [n]: those whose normals are turned toward it (the body is convex)."""
        limit = self.photo.normals[:, 2].min()
        return view.normals[:, 2] >= limit

    def at(self, view: Seen, values: Radiance, unseen: bool = True) -> Radiance:
        """values: of the photo's points;  unseen: whether points that it does not see are filled, else they are 0."""
        there = self.seen(view)
        found = np.zeros((len(view.points), 3))
        found[there] = _weighted(self._points, view.points[there], values, BETWEEN)
        if unseen and not there.all():
            found[~there] = _weighted(self._normals, view.normals[~there], values, NEAREST)
        return found


def _weighted(tree: cKDTree, at: np.ndarray, values: Radiance, count: int) -> Radiance:
    distance, index = tree.query(at, count)
    weight = 1 / (distance + 1e-9)
    return np.einsum("nk,nkc->nc", weight / weight.sum(axis=1, keepdims=True), values[index])


class Projective(msgspec.Struct, frozen=True):
    """Textures by material and light."""

    photos: Photos
    texture: Texture
    materials: dict[str, Reflectance] = {}
    lights: dict[int, Map] = {}
    lambertian: bool = False

    def new_view(self, material: str, light: int, seen: Seen) -> Radiance:
        """The photo in that light, carried over."""
        return self.texture.at(seen, self.photos.radiance[material, light])

    def new_light(self, material: str, light: Map, seen: Seen) -> Radiance:
        """The mean of the material's photos, whatever the light."""
        shown = [radiance for (name, _), radiance in self.photos.radiance.items() if name == material]
        return self.texture.at(seen, np.mean(shown, axis=0))

    def new_material(self, material: Reflectance, light: int, seen: Seen) -> Radiance | None:
        """A texture knows no light apart from its material."""
        return None


def projective(photos: Photos) -> Projective:
    """The photos as textures."""
    return Projective(photos, Texture(photos.seen))
