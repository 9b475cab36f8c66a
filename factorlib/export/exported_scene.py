"""A photo's scene as every export format writes it: camera, objects in files of one material each, and light.

For Blender it is written as JSON, beside a script that is the same for every set (`blender.py.txt` in this package,
exported as `blender.py`) and needs nothing but Blender.  A `.blend` file would need Blender to be written and would not
be the same bytes twice.  The JSON has, in plain numbers:

    camera     width, height, focal_px, principal_point in pixels, centres at 0.5
    shapes     name, file (relative), material, cam_from_object: 4 × 4, rows, mesh units, OpenCV's camera axes;
               only if painted: image (relative), k_d in sRGB by the file's texture coordinates s, t
    materials  diffuse k_d, specular k_s (linear Rec. 709), roughness
    light      file (relative): lat-long map of texel means, exposure: factor per channel, camera_from_light: 3 × 3
    suns       not in the map: direction (toward it, y-up camera frame), irradiance (RGB), angular_diameter_deg
    max_depth  2 direct light alone, −1 all bounces

Frame  The camera frame turned y-up (x right, y up, z toward the viewer), the camera at the origin.
       `YUP_FROM_CAMERA @ cam_from_object` places an object.  Maps of lights have OpenEXR's layout in that frame,
       so that only a light fixed to the world is rotated.
"""

from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path, PurePosixPath
from typing import Any

import msgspec
import numpy as np
from jaxtyping import Float

from factorlib.conventions import YUP_FROM_CAMERA
from factorlib.geometry.camera import Camera
from factorlib.jsonfile import write_json
from factorlib.light.lobes import SUN_DEG, Lobes, lobe_energy
from factorlib.results.materials import Reflectance
from factorlib.tracing.scene import rigid
from factorlib.wholefile import write_text

DIRECT = 2  # max_depth of direct light alone
ALL_BOUNCES = -1  # max_depth of all bounces


class ExportedShape(msgspec.Struct, frozen=True):
    """A PLY file of one material, and its pose.

    Attributes:
        file: relative to the scene
        two_sided: True if the inside can be visible
        image: file of k_d as an sRGB image by the texture coordinates of `file`, if it is painted, else empty
    """

    name: str
    file: str
    material: str
    cam_from_object: Float[np.ndarray, "4 4"]
    two_sided: bool
    image: str = ""

    @property
    def vertex_colours(self) -> str:
        """The file of a painted shape whose vertices have its colours, relative to the scene."""
        return str(PurePosixPath(self.file).with_suffix(".vertices.ply"))

    @property
    def world_from_object(self) -> Float[np.ndarray, "4 4"]:
        """The transform into the y-up camera frame."""
        return rigid(YUP_FROM_CAMERA, (0, 0, 0)) @ self.cam_from_object


class ExposedMap(msgspec.Struct, frozen=True):
    """A lat-long map with an exposure and a rotation.

    Attributes:
        file: relative to the scene
        exposure: factor per channel
        camera_from_light: rotation of the light; the identity unless the light is fixed to the world
    """

    file: str
    exposure: Float[np.ndarray, "3"]
    camera_from_light: Float[np.ndarray, "3 3"]

    @property
    def world_from_light(self) -> Float[np.ndarray, "4 4"]:
        """The rotation of the map's own axes into the y-up camera frame."""
        return rigid(YUP_FROM_CAMERA @ self.camera_from_light @ YUP_FROM_CAMERA, (0, 0, 0))


class Sun(msgspec.Struct, frozen=True):
    """A directional light, which the map of a scene does not contain.

    Attributes:
        direction: unit, toward the sun, in the y-up camera frame
        irradiance: on a surface that faces the sun, radiance × steradian
    """

    direction: Float[np.ndarray, "3"]
    irradiance: Float[np.ndarray, "3"]
    angular_diameter_deg: float = SUN_DEG

    def to_dict(self) -> dict[str, Any]:
        """Return the sun as plain numbers, for JSON."""
        return _to_dict(self, "direction", "irradiance", "angular_diameter_deg")


def extract_suns(lobes: Lobes, rotation: Float[np.ndarray, "3 3"]) -> list[Sun]:
    """Return the suns of a light, turned by a rotation from the lobes' frame."""
    suns = lobes.take(lobes.suns)
    energies = suns.weight * lobe_energy(suns.sharpness)[:, None]
    return [Sun(axis, energy) for axis, energy in zip(suns.axis @ rotation.T, energies, strict=True)]


class ExportedScene(msgspec.Struct, frozen=True):
    """A photo's camera, shapes, materials and light.

    Attributes:
        materials: reflectances by name, at least those that shapes name
        max_depth: DIRECT or ALL_BOUNCES, as in the solve
        suns: directional lights beside the map
    """

    camera: Camera
    shapes: Sequence[ExportedShape]
    materials: Mapping[str, Reflectance]
    light: ExposedMap
    max_depth: int = DIRECT
    suns: Sequence[Sun] = ()

    @property
    def clip_distances(self) -> tuple[float, float]:
        """The near and far clipping distances, generous because the meshes' extents are unknown here."""
        distances = [float(np.linalg.norm(shape.cam_from_object[:3, 3])) for shape in self.shapes] or [1.0]
        return 1e-3 * min(distances), 1e3 * max(distances)


def write_script(folder: str | Path) -> None:
    """Write blender.py, which builds the scenes that `write_scene_json` writes to the same folder."""
    script = files("factorlib.export").joinpath("blender.py.txt").read_text(encoding="utf-8")
    write_text(Path(folder) / "blender.py", script)


def write_scene_json(path: str | Path, scene: ExportedScene) -> None:
    """Write a photo's scene as JSON, with the materials that its shapes name."""
    camera = scene.camera
    write_json(
        path,
        {
            "camera": {
                "width": camera.width,
                "height": camera.height,
                "focal_px": camera.focal,
                "principal_point": camera.centre,
            },
            "shapes": [
                _to_dict(shape, "name", "file", "material", "cam_from_object", *["image"] * bool(shape.image))
                for shape in scene.shapes
            ],
            "materials": {shape.material: scene.materials[shape.material] for shape in scene.shapes},
            "light": _to_dict(scene.light, "file", "exposure", "camera_from_light"),
            "suns": [sun.to_dict() for sun in scene.suns],
            "max_depth": scene.max_depth,
        },
    )


def _to_dict(item: ExportedShape | ExposedMap | Sun, *names: str) -> dict[str, Any]:
    values = {name: getattr(item, name) for name in names}
    return {name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in values.items()}
