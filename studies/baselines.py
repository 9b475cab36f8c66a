"""Baselines of the comparison, as predictions of photos that were not taken.

Projective   Texturing: the photo's pixels are projected onto the sphere and rendered from the new view, which needs the
             sphere and the camera.  Points in the photo are interpolated by inverse distance between `BETWEEN` pixels;
             points outside it take the colour of the `NEAREST` ones.  A new light changes nothing: the colours
             are the mean of all photos of the material.
Grey         Every material is the same grey Lambert, every light is even, of its photo's mean colour: the null.
Rendered     Reflectances and lights of a method that recovers both are rendered as the truth is.

Truths are handed to methods for the gauge alone: photos link all materials and all lights.
"""

from collections.abc import Callable

import msgspec
import numpy as np
from scipy.spatial import cKDTree

from factorlib.results.materials import Reflectance
from studies.recovery_errors import Materials, in_gauge
from studies.spheres import Map, Photos, Radiance, SphereView

BETWEEN = 4  # pixels of the photo that a point is between
NEAREST = 12  # pixels that colour a point outside the photo
ALBEDO = 0.5  # of the grey ball
ROWS = 32  # of the maps of even lights


class MethodPrediction(msgspec.Struct, frozen=True):
    """Answer of a method of the comparison.

    Attributes:
        materials: Reflectances that it states, by name, in the truth's gauge.
        lights: Maps that it states, by number, in that gauge.
        render: Radiance of a material in a light as a camera sees it: a photographed material by its name, or a new
            one; a photo's light by its number, or a new one; at most one of them is new.  None if the method has no
            answer.
    """

    materials: dict[str, Reflectance]
    lights: dict[int, Map]
    render: Callable[[str | Reflectance, int | Map, SphereView], Radiance | None]


def predict_by_rendering(materials: dict[str, Reflectance], lights: dict[int, Map]) -> MethodPrediction:
    """Predict by the reflectance of each material and the map of each light."""

    def render(material: str | Reflectance, light: int | Map, view: SphereView) -> Radiance:
        material = materials[material] if isinstance(material, str) else material
        return view.render(material, lights[light] if isinstance(light, int) else light)

    return MethodPrediction(materials, lights, render)


def predict_grey(photos: Photos, truths: Materials) -> MethodPrediction:
    """Predict every picture by the mean colours of the photos."""
    ball = Reflectance((ALBEDO,) * 3, (0.0,) * 3, 1.0)
    lights = {}
    for li in photos.lights:
        colour = np.mean([values.mean(axis=0) for (_, k), values in photos.radiance.items() if k == li], axis=0)
        lights[li] = np.broadcast_to(colour / ALBEDO, (ROWS, 2 * ROWS, 3))
    return predict_by_rendering(*in_gauge(dict.fromkeys(photos.materials, ball), lights, truths))


class Texture:
    """Values at the points that a photo sees, to be rendered from other views."""

    def __init__(self, photo: SphereView):
        self._tree = cKDTree(photo.normals)
        self._least = photo.normals[:, 2].min()

    def render(self, view: SphereView, values: Radiance) -> Radiance:
        """Return the photo's values at the points that a view sees; points outside the photo are extrapolated."""
        visible = view.normals[:, 2] >= self._least
        colours = np.zeros((len(view.normals), 3))
        for points, count in ((visible, BETWEEN), (~visible, NEAREST)):
            distance, index = self._tree.query(view.normals[points], count)
            weight = 1 / (distance + 1e-9)
            colours[points] = np.einsum("nk,nkc->nc", weight / weight.sum(axis=1, keepdims=True), values[index])
        return colours


def predict_by_projection(photos: Photos, truths: Materials) -> MethodPrediction:
    """Predict by the photos as textures; a texture knows no light apart from its material."""
    texture = Texture(photos.view)
    radiance = photos.radiance

    def render(material: str | Reflectance, light: int | Map, view: SphereView) -> Radiance | None:
        if isinstance(material, Reflectance):
            return None
        if isinstance(light, int):
            return texture.render(view, radiance[material, light])
        return texture.render(view, np.mean([v for (name, _), v in radiance.items() if name == material], axis=0))

    return MethodPrediction({}, {}, render)
