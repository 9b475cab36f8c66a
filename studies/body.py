"""Sphere of the comparison of methods, seen from the photos' side and from others, and its photos.

Points and normals of a sphere of radius 1 are the same, in the photo's light frame (x right, y up, z toward the
viewer).  A camera that went around it is given by `turn`, view_from_photo, a rotation; the sphere and its light, a
lat-long map, stay where they are.
"""

from collections.abc import Mapping

import msgspec
import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from factorlib.evaluate.ball import ball, octahedral_light
from factorlib.geometry.sphere import ball_normals
from factorlib.light.latlong import rotate_map
from factorlib.results.materials import Reflectance
from factorlib.urm.observations import Observations
from studies.errors import Map
from studies.spheres import GRAZING, observations_of
from studies.study import Comparison

FINER = 2  # samples along a texel's side where a map is turned
Radiance = Float[np.ndarray, "n 3"]


class View(msgspec.Struct, frozen=True):
    """Points that a camera sees in a picture, in rows: its pixels `inside`.

    normals: photo's light frame;  turn: view_from_photo
    """

    inside: Bool[np.ndarray, "h w"]
    normals: Float[np.ndarray, "n 3"]
    turn: Float[np.ndarray, "3 3"]

    def picture(self, radiance: Radiance) -> Float[np.ndarray, "h w 3"]:
        """Return the points' radiance in their pixels, 0 elsewhere."""
        pixels = np.zeros((*self.inside.shape, 3))
        pixels[self.inside] = radiance
        return pixels


def turn(azimuth_deg: float, elevation_deg: float) -> Float[np.ndarray, "3 3"]:
    """Return view_from_photo of a camera that went to the right, then up, about the sphere.

    >>> turn(90, 0).round(6).tolist()[2]
    [1.0, 0.0, 0.0]
    """
    return Rotation.from_euler("yx", [-azimuth_deg, elevation_deg], degrees=True).as_matrix()


def view(size: int, view_from_photo: Float[np.ndarray, "3 3"] = np.eye(3)) -> View:
    """Return what a camera sees in a picture `size` pixels across, but for pixels at a grazing angle."""
    normals, inside = ball_normals(size)
    inside[inside] = kept = normals[:, 2] > GRAZING
    return View(inside, normals[kept] @ view_from_photo, view_from_photo)


def shown(material: Reflectance, light: Map, view: View) -> Radiance:
    """Render the sphere in a light, as a camera sees it: by quadrature of the light's map, as in other studies.

    For a camera that went around both, the map is turned into the camera's own frame.  Truth and answers go through the
    same turn.
    """
    ahead = np.array_equal(view.turn, np.eye(3))
    light = light if ahead else rotate_map(light, view.turn, FINER)
    return ball(octahedral_light(light), material, view.normals @ view.turn.T)


class Photos(msgspec.Struct, frozen=True):
    """Photos that all methods see: the sphere from their camera, and its radiance by material's name and light."""

    view: View
    radiance: dict[tuple[str, int], Radiance]

    @property
    def materials(self) -> list[str]:
        """Names of the materials, in order of their first photo."""
        return list(dict.fromkeys(name for name, _ in self.radiance))

    @property
    def lights(self) -> list[int]:
        """Numbers of the lights, sorted."""
        return sorted({light for _, light in self.radiance})


def photographed(
    case: Comparison, materials: Mapping[str, Reflectance], lights: Mapping[int, Map]
) -> tuple[Photos, dict[str, Observations]]:
    """Return the photos of a case, and the same as the stage `urm` hands them to `solve`."""
    tables = observations_of(case, materials, {li: octahedral_light(lights[li]) for li in case.lights})
    radiance = {}
    for li, table in zip(case.lights, tables.values(), strict=True):
        for m in np.unique(table.material):
            radiance[table.materials[m], li] = table.radiance[table.material == m]
    return Photos(view(case.size), radiance), tables
