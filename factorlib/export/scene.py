"""A photo's scene, as it is written for every program: its camera, its objects in files of one material each, and its light.

Frame     The camera frame turned y-up (x right, y up, z toward the viewer), the camera at the origin: `YUP_FROM_CAMERA @ cam_from_object`
          places an object.  Maps of lights have OpenEXR's layout in that frame, so that only a light fixed to the world turns.
"""

from collections.abc import Mapping, Sequence

import msgspec
import numpy as np
from jaxtyping import Float

from factorlib.conventions import YUP_FROM_CAMERA
from factorlib.geometry.camera import Camera
from factorlib.light.lobes import SUN_DEG, Lobes, lobe_integral
from factorlib.results.materials import Reflectance

DIRECT, ALL_BOUNCES = 2, -1


class Shape(msgspec.Struct, frozen=True):
    """A PLY file (relative to the scene) of one material, and where it stands;  two_sided: the inside can be seen

    painted: its diffuse part has the colours of the file's vertices
    """

    name: str
    file: str
    material: str
    cam_from_object: Float[np.ndarray, "4 4"]
    two_sided: bool
    painted: bool = False

    @property
    def world_from_object(self) -> Float[np.ndarray, "4 4"]:
        """The transform into the y-up turn of the camera frame."""
        return _turn(YUP_FROM_CAMERA) @ self.cam_from_object


class ExposedMap(msgspec.Struct, frozen=True):
    """A lat-long map (relative to the scene), a factor per channel on it, and camera_from_light: the identity unless fixed to the world."""

    file: str
    exposure: Float[np.ndarray, "3"]
    camera_from_light: Float[np.ndarray, "3 3"]

    @property
    def world_from_light(self) -> Float[np.ndarray, "4 4"]:
        """The rotation of the map's own axes into the y-up turn of the camera frame."""
        return _turn(YUP_FROM_CAMERA @ self.camera_from_light @ YUP_FROM_CAMERA)


class Sun(msgspec.Struct, frozen=True):
    """Light from one direction, which the map of a scene does not hold.

    direction: toward it, unit, in the y-up turn of the camera frame;  irradiance: of a surface that faces it, radiance × steradian
    """

    direction: Float[np.ndarray, "3"]
    irradiance: Float[np.ndarray, "3"]
    angular_diameter_deg: float = SUN_DEG


def suns_of(lobes: Lobes, rotation: Float[np.ndarray, "3 3"]) -> list[Sun]:
    """The suns of a light, turned by a rotation from the lobes' frame."""
    suns = lobes.take(lobes.suns)
    energies = suns.weight * lobe_integral(suns.sharpness)[:, None]
    return [Sun(axis, energy) for axis, energy in zip(suns.axis @ rotation.T, energies, strict=True)]


class Scene(msgspec.Struct, frozen=True):
    """materials: by name, at least those that shapes name;  max_depth: DIRECT or ALL_BOUNCES, as the light was solved for;  suns: beside the map"""

    camera: Camera
    shapes: Sequence[Shape]
    materials: Mapping[str, Reflectance]
    light: ExposedMap
    max_depth: int = DIRECT
    suns: Sequence[Sun] = ()

    @property
    def clip_distances(self) -> tuple[float, float]:
        """Near and far, of the objects' distances: generous, for the meshes' extents are not known here."""
        distances = [float(np.linalg.norm(shape.cam_from_object[:3, 3])) for shape in self.shapes] or [1.0]
        return 1e-3 * min(distances), 1e3 * max(distances)


def _turn(rotation: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "4 4"]:
    matrix = np.eye(4)
    matrix[:3, :3] = rotation
    return matrix
