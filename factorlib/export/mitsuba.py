"""Export of a photo's scene to Mitsuba 3: its camera, its objects with the solved materials, and its light.

Camera    Mitsuba's principal point offset counts against the axes of the picture: (W/2 − c_x)/W, (H/2 − c_y)/H.
Material  A dictionary of `factorlib.tracing.scene.bsdf`.  The whole scene is built of such dictionaries and written as
          XML.
Light     A map, and a directional emitter for each sun.  `max_depth` is as in the solve: 2 for direct light without
          bounces between objects, −1 for all bounces.  `mitsuba -D max_depth=-1 scene.xml` traces them in any case;
          `-D spp=…` sets the samples per pixel.
Gauge     Mitsuba refuses reflectances above one, and its mixture needs max k_d + max k_s ≤ 1 − 1e-5 of every material.
          Only the product of reflectance and light is known.  If a material exceeds the limit, one factor for the whole
          set moves from all reflectances into all lights.  Every material then keeps its radiance in every light, also
          across photos that share nothing.  Paint counts by its brightest places but for 2 % of its surface,
          which is written as 1.
"""

import xml.etree.ElementTree as ET
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from factorlib.export.exported_scene import ExportedScene
from factorlib.meshes.mesh import Mesh, area_vectors
from factorlib.results.materials import MaterialTable, PaintRange, Reflectance, SolvedMaterial, StandardErrors
from factorlib.tracing.scene import bsdf
from factorlib.wholefile import write_text

VERSION = "3.0.0"
SAMPLES = 256  # default samples per pixel
KINDS = {bool: "boolean", int: "integer", float: "float", str: "string"}


def write_scene(path: str | Path, scene: ExportedScene) -> None:
    """Write the scene as XML for Mitsuba; its light must have a grey exposure and a map in Mitsuba's layout."""
    root = ET.Element("scene", version=VERSION)
    for name, value in {"spp": SAMPLES, "max_depth": scene.max_depth}.items():
        ET.SubElement(root, "default", name=name, value=str(value))
    _add(root, "integrator", {"type": "path", "max_depth": "$max_depth", "hide_emitters": True})
    _add(root, "sensor", _sensor(scene))
    light = {"type": "envmap", "filename": scene.light.file, "scale": float(scene.light.exposure[0])}
    _add(root, "emitter", {**light, "to_world": _matrix(scene.light.world_from_light)})
    for sun in scene.suns:
        shines = {"type": "directional", "direction": -sun.direction}
        _add(root, "emitter", {**shines, "irradiance": {"type": "rgb", "value": sun.irradiance}})
    for name, two_sided, painted in sorted({(s.material, s.two_sided, bool(s.image)) for s in scene.shapes}):
        surface = bsdf(scene.materials[name], painted)
        surface = {"type": "twosided", "bsdf": surface} if two_sided else surface
        _add(root, "bsdf", surface, id=_id(name, two_sided, painted))
    for shape in scene.shapes:
        file = {"type": "ply", "filename": shape.vertex_colours if shape.image else shape.file}
        place = _matrix(shape.world_from_object)
        element = _add(root, "shape", {**file, "to_world": place}, id=shape.name)
        ET.SubElement(element, "ref", id=_id(shape.material, shape.two_sided, bool(shape.image)))
    ET.indent(root, " ")
    write_text(path, ET.tostring(root, encoding="unicode") + "\n")


def material_xml(name: str, material: Reflectance) -> str:
    """Return a material alone as XML: a `bsdf` with the id `name`, which any scene can refer to."""
    element = _add(ET.Element("scene"), "bsdf", bsdf(material), id=name)
    ET.indent(element, " ")
    return ET.tostring(element, encoding="unicode").strip()


def _sensor(scene: ExportedScene) -> dict[str, Any]:
    camera = scene.camera
    cx, cy = camera.centre
    near, far = scene.clip_distances
    film = {
        "type": "hdrfilm",
        "width": camera.width,
        "height": camera.height,
        "pixel_format": "rgb",
        "component_format": "float32",
    }
    return {
        "type": "perspective",
        "fov": float(np.degrees(2 * np.arctan(camera.width / (2 * camera.focal)))),
        "principal_point_offset_x": (camera.width / 2 - cx) / camera.width,
        "principal_point_offset_y": (camera.height / 2 - cy) / camera.height,
        "near_clip": near,
        "far_clip": far,
        "fov_axis": "x",
        "to_world": ("lookat", {"origin": "0, 0, 0", "target": "0, 0, -1", "up": "0, 1, 0"}),
        "film": {**film, "rfilter": {"type": "box"}},
        "sampler": {"type": "multijitter", "sample_count": "$spp"},
    }


def _id(material: str, two_sided: bool, painted: bool) -> str:
    return f"material.{material}" + ".two_sided" * two_sided + ".painted" * painted


def _matrix(matrix: np.ndarray) -> tuple[str, dict[str, str]]:
    return "matrix", {"value": _numbers(matrix.reshape(-1))}


def _add(parent: ET.Element, tag: str, entry: dict[str, Any], **attributes: str) -> ET.Element:
    """Add Mitsuba's dictionary of a plugin as an element, with a child for each value.

    A value "$…" refers to a default and is an integer.
    """
    element = ET.SubElement(parent, tag, {"type": entry["type"], **attributes})
    for name, value in entry.items():
        if isinstance(value, tuple):
            ET.SubElement(ET.SubElement(element, "transform", name=name), *value)
        elif isinstance(value, dict) and value["type"] == "rgb":
            ET.SubElement(element, "rgb", name=name, value=_numbers(value["value"]))
        elif isinstance(value, dict) and value["type"] == "mesh_attribute":
            ET.SubElement(
                _add(element, "texture", {"type": value["type"]}, name=name), "string", name="name", value=value["name"]
            )
        elif isinstance(value, np.ndarray):
            ET.SubElement(element, "vector", name=name, value=_numbers(value))
        elif isinstance(value, dict):
            _add(element, name.partition("_")[0], value)
        elif name != "type":
            text = _numbers([value]) if isinstance(value, float) else str(value)
            kind = "integer" if text.startswith("$") else KINDS[type(value)]
            ET.SubElement(element, kind, name=name, value=text.lower() if kind == "boolean" else text)
    return element


def _numbers(values: Iterable[float]) -> str:
    return " ".join(repr(float(value) + 0.0) for value in values)


HEADROOM = 1e-5
# Share of a painted surface that does not count: where a mesh puts a shadow that the photos do not have, paint comes
# out several times too bright (1 % of a jug's hull in the sun, which halved all reflectances).
BRIGHTEST_SHARE = 0.02
RULE = (
    "where max diffuse + max specular of a material or of its paint exceeds 1 - 1e-5, "
    "one factor moves from all reflectances to all lights"
)


def headroom_factor(materials: Mapping[str, Reflectance], paint: Mapping[str, PaintRange] = {}) -> float:
    """Return the factor that brings all reflectances and all paint within the limit; 1 if they already are.

    >>> headroom_factor({"red": Reflectance((0.9, 0.1, 0.1), (0.1, 0.1, 0.3), 0.3)})
    0.8333250000000001
    """
    brightest = max([*(m.total for m in materials.values()), *(p.brightest for p in paint.values())], default=0.0)
    limit = 1 - HEADROOM
    return 1.0 if brightest <= limit else limit / brightest


def paint_range(material: Reflectance, meshes: Iterable[Mesh]) -> PaintRange:
    """Return the brightest paint of a material on parts of it that have detail."""
    # k_d f of Mitsuba's mixture, which is at most 1 where k_d f · total / max k_d is
    factors = [mesh.detail[mesh.faces].mean(axis=1) for mesh in meshes if mesh.detail is not None]
    areas = [np.linalg.norm(area_vectors(m.vertices, m.faces), axis=1) for m in meshes if m.detail is not None]
    if not factors or max(material.diffuse) == 0:
        return PaintRange(0.0, 0.0)
    brightness = material.total / max(material.diffuse) * (np.vstack(factors) * material.diffuse).max(axis=1)
    area = np.concatenate(areas)
    order = np.argsort(-brightness)
    place = int(np.searchsorted(np.cumsum(area[order]), BRIGHTEST_SHARE * area.sum()))
    return PaintRange(float(brightness[order[place]]), float(area[brightness > 1].sum() / area.sum()))


def table_in_gauge(table: MaterialTable, factor: float, paint: Mapping[str, PaintRange] = {}) -> MaterialTable:
    """Return the table with reflectances and standard errors times `factor`, which `gauge` records."""
    above = {name: each for name, each in sorted(paint.items()) if each.above > 0}
    gauge = msgspec.structs.replace(table.gauge, export_factor=factor, export_rule=RULE, paint=above or msgspec.UNSET)

    def scale(values: SolvedMaterial | StandardErrors) -> SolvedMaterial | StandardErrors:
        """Return the diffuse and specular values times the factor."""
        diffuse, specular = (tuple(factor * v for v in colour) for colour in (values.diffuse, values.specular))
        return msgspec.structs.replace(values, diffuse=diffuse, specular=specular)

    materials = {n: msgspec.structs.replace(scale(m), stderr=scale(m.stderr)) for n, m in table.materials.items()}
    return msgspec.structs.replace(table, materials=materials, gauge=gauge)
