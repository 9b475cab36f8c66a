"""A scene for Mitsuba 3: the photo's camera, its objects in their poses with the solved materials, and its light.

Frame      The camera frame turned y-up, camera at the origin: `YUP_FROM_CAMERA @ cam_from_object` places an object.
Camera     Mitsuba's principal point offset counts against the axes of the picture: (W/2 − c_x)/W, (H/2 − c_y)/H.
Material   k_d/π + k_s D G/(4 …) is a mixture, weight w = max k_s / (max k_d + max k_s), of `diffuse` with k_d/(1−w) and
           `roughconductor` (material none: no Fresnel) with k_s/w.  w = 0, w = 1 and black have no mixture.
Light      As it was solved for: seen directly, without bounces between objects (`max_depth` 2), or with all of them (−1).
           `mitsuba -D max_depth=-1 scene.xml` traces them in any case; `-D spp=…` sets the samples per pixel.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path

import msgspec
import numpy as np
from jaxtyping import Float

from factorlib.conventions import YUP_FROM_CAMERA
from factorlib.results.materials import Reflectance
from factorlib.wholefile import write_text

VERSION = "3.0.0"
SAMPLES, DIRECT, ALL_BOUNCES = 256, 2, -1


class View(msgspec.Struct, frozen=True):
    """A pinhole camera: size, focal length and principal point in pixels, centres at 0.5."""

    width: int
    height: int
    focal_px: float
    principal_point: tuple[float, float]


class Shape(msgspec.Struct, frozen=True):
    """A mesh file (relative to the scene) of one material, and where it stands.

    two_sided: the inside can be seen
    """

    name: str
    file: str
    material: str
    cam_from_object: Float[np.ndarray, "4 4"]
    two_sided: bool


class Environment(msgspec.Struct, frozen=True):
    """A lat-long map (relative to the scene), a factor on it, and camera_from_light: the identity unless fixed to the world."""

    file: str
    scale: float
    camera_from_light: Float[np.ndarray, "3 3"]


def write_scene(
    path: str | Path,
    view: View,
    shapes: Sequence[Shape],
    materials: dict[str, Reflectance],
    light: Environment,
    max_depth: int = DIRECT,
) -> None:
    """Write the scene as XML; of `materials`, by name, those that shapes name."""
    scene = ET.Element("scene", version=VERSION)
    for name, value in {"spp": SAMPLES, "max_depth": max_depth}.items():
        ET.SubElement(scene, "default", name=name, value=str(value))
    integrator = ET.SubElement(scene, "integrator", type="path")
    _values(integrator, integer={"max_depth": "$max_depth"}, boolean={"hide_emitters": "true"})
    _add_sensor(scene, view, shapes)
    _add_light(scene, light)
    for name, two_sided in sorted({(shape.material, shape.two_sided) for shape in shapes}):
        _add_material(scene, name, materials[name], two_sided)
    for shape in shapes:
        _add_shape(scene, shape)
    ET.indent(scene, " ")
    write_text(path, ET.tostring(scene, encoding="unicode") + "\n")


def material_xml(name: str, material: Reflectance) -> str:
    """A material alone, as XML: a `bsdf` with the id `name`, to which a scene of one's own can refer."""
    scene = ET.Element("scene")
    _add_bsdf(scene, material, {"id": name})
    ET.indent(scene, " ")
    return ET.tostring(scene[0], encoding="unicode").strip()


def _add_sensor(scene: ET.Element, view: View, shapes: Sequence[Shape]) -> None:
    sensor = ET.SubElement(scene, "sensor", type="perspective")
    (cx, cy), (w, h) = view.principal_point, (view.width, view.height)
    offset = {"principal_point_offset_x": (w / 2 - cx) / w, "principal_point_offset_y": (h / 2 - cy) / h}
    near, far = clip_distances(shapes)
    field = float(np.degrees(2 * np.arctan(w / (2 * view.focal_px))))
    _values(sensor, float={"fov": field, **offset, "near_clip": near, "far_clip": far}, string={"fov_axis": "x"})
    to_world = ET.SubElement(sensor, "transform", name="to_world")
    ET.SubElement(to_world, "lookat", origin="0, 0, 0", target="0, 0, -1", up="0, 1, 0")
    film = ET.SubElement(sensor, "film", type="hdrfilm")
    _values(film, integer={"width": w, "height": h}, string={"pixel_format": "rgb", "component_format": "float32"})
    ET.SubElement(film, "rfilter", type="box")
    _values(ET.SubElement(sensor, "sampler", type="multijitter"), integer={"sample_count": "$spp"})


def clip_distances(shapes: Sequence[Shape]) -> tuple[float, float]:
    """Near and far, of the objects' distances: generous, for the meshes' extents are not known here."""
    distances = [float(np.linalg.norm(shape.cam_from_object[:3, 3])) for shape in shapes] or [1.0]
    return 1e-3 * min(distances), 1e3 * max(distances)


def _add_light(scene: ET.Element, light: Environment) -> None:
    emitter = ET.SubElement(scene, "emitter", type="envmap")
    _values(emitter, string={"filename": light.file}, float={"scale": light.scale})
    to_world = np.eye(4)
    to_world[:3, :3] = YUP_FROM_CAMERA @ light.camera_from_light @ YUP_FROM_CAMERA
    _add_transform(emitter, to_world)


def _add_shape(scene: ET.Element, shape: Shape) -> None:
    element = ET.SubElement(scene, "shape", type="ply", id=shape.name)
    _values(element, string={"filename": shape.file})
    turn = np.eye(4)
    turn[:3, :3] = YUP_FROM_CAMERA
    _add_transform(element, turn @ shape.cam_from_object)
    ET.SubElement(element, "ref", id=_id(shape.material, shape.two_sided))


def _id(material: str, two_sided: bool) -> str:
    return f"material.{material}.two_sided" if two_sided else f"material.{material}"


def _add_material(scene: ET.Element, name: str, material: Reflectance, two_sided: bool) -> None:
    if two_sided:
        _add_bsdf(ET.SubElement(scene, "bsdf", type="twosided", id=_id(name, two_sided)), material, {})
    else:
        _add_bsdf(scene, material, {"id": _id(name, two_sided)})


def _add_bsdf(parent: ET.Element, material: Reflectance, attributes: dict[str, str]) -> None:
    diffuse, specular = np.array(material.diffuse, dtype=float), np.array(material.specular, dtype=float)
    if not specular.any():
        _add_diffuse(parent, diffuse, attributes)
    elif not diffuse.any():
        _add_conductor(parent, specular, material.alpha, attributes)
    else:
        weight = specular.max() / material.total
        blend = ET.SubElement(parent, "bsdf", type="blendbsdf", **attributes)
        _values(blend, float={"weight": weight})
        _add_diffuse(blend, diffuse / (1 - weight), {})
        _add_conductor(blend, specular / weight, material.alpha, {})


def _add_diffuse(parent: ET.Element, reflectance: np.ndarray, attributes: dict[str, str]) -> None:
    _values(ET.SubElement(parent, "bsdf", type="diffuse", **attributes), rgb={"reflectance": _numbers(reflectance)})


def _add_conductor(parent: ET.Element, reflectance: np.ndarray, alpha: float, attributes: dict[str, str]) -> None:
    conductor = ET.SubElement(parent, "bsdf", type="roughconductor", **attributes)
    _values(conductor, string={"material": "none", "distribution": "ggx"}, float={"alpha": alpha})
    _values(conductor, rgb={"specular_reflectance": _numbers(reflectance)})


def _add_transform(parent: ET.Element, matrix: Float[np.ndarray, "4 4"]) -> None:
    ET.SubElement(ET.SubElement(parent, "transform", name="to_world"), "matrix", value=_numbers(matrix.reshape(-1)))


def _values(parent: ET.Element, **kinds: dict[str, object]) -> None:
    """One element per value, e.g. float={"fov": 40.0}."""
    for kind, values in kinds.items():
        for name, value in values.items():
            ET.SubElement(parent, kind, name=name, value=_number(value) if isinstance(value, float) else str(value))


def _number(value: float) -> str:
    return repr(float(value) + 0.0)


def _numbers(values: np.ndarray) -> str:
    return " ".join(_number(v) for v in values)
