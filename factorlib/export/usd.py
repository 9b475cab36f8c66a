"""A photo's scene as OpenUSD text, written here: no USD library is needed, and the same scene is the same bytes.

    /scene/camera, light, materials/<material>, objects/<object>/<material>;  /Render/photo: the size in pixels

Frame     The camera frame turned y-up (x right, y up, z toward the viewer), in the poses' units; the camera stands at the origin and
          looks along −z, as every USD camera does.  USD multiplies rows from the left: matrices are written transposed.
Camera    Apertures are fractions of FILM wide; their offset is where the picture's middle is, right of and above the principal point.
Light     A dome light's map has OpenEXR's layout, top +y, middle +z, as the exported maps have it: only a light fixed to the world turns.
Material  UsdPreviewSurface: GGX of α = roughness², Schlick's F from F0 to F90, diffuseColor × (1 − F) per channel (`shader_inputs`).
Meshes    A file for each part of one material, beside the PLY file, to which scenes refer.
Names     Every prim bears the name of the data set as displayName; its identifier is that name where USD allows it (`identifiers`).
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path, PurePosixPath

import msgspec
import numpy as np
from jaxtyping import Float

from factorlib.conventions import YUP_FROM_CAMERA
from factorlib.export.blender import ExposedMap
from factorlib.export.mitsuba import Shape, View, clip_distances
from factorlib.meshes.mesh import Mesh
from factorlib.results.materials import Reflectance
from factorlib.wholefile import write_text

FILM = 0.36  # width of the film in tenths of a unit: 36 mm where a unit is a metre; only its ratio to the focal length counts
SUFFIX = ".usda"
INDENT = "    "
UP_AXIS = ["metersPerUnit = 1", 'upAxis = "Y"']  # what a unit of the poses is in metres is not known
ESCAPES = {"\\": "\\\\", '"': '\\"', "\n": "\\n", "\r": "\\r", "\t": "\\t"}


def write_usd_scene(
    path: str | Path, view: View, shapes: Sequence[Shape], materials: Mapping[str, Reflectance], light: ExposedMap
) -> None:
    """Write a photo's scene; of `materials` those that shapes name.  A shape's file has a twin by `write_usd_mesh`."""
    write_text(path, scene_text(view, shapes, materials, light))


def scene_text(view: View, shapes: Sequence[Shape], materials: Mapping[str, Reflectance], light: ExposedMap) -> str:
    """What `write_usd_scene` writes."""
    named = identifiers(sorted({shape.material for shape in shapes}))
    scene = [*_camera(view, shapes), *_light(light), *_materials(materials, named), *_objects(shapes, named)]
    film = ["rel camera = </scene/camera>", f"uniform int2 resolution = ({view.width}, {view.height})"]
    about = ['defaultPrim = "scene"', UP_AXIS[0], 'renderSettingsPrimPath = "/Render/photo"', UP_AXIS[1]]
    render = _prim('Scope "Render"', _prim('RenderSettings "photo"', film))
    return _layer(about, [*_prim('Xform "scene"', scene), *render])


def write_usd_mesh(path: str | Path, mesh: Mesh) -> None:
    """Write a mesh in its own frame and units, as float32; /mesh, without a material."""
    points, normals = (array.astype(np.float32).astype(float) + 0.0 for array in (mesh.vertices, mesh.normals))
    lines = [
        f"uniform bool doubleSided = {int(mesh.open)}",
        f"float3[] extent = [{_tuples(np.stack([points.min(axis=0), points.max(axis=0)]))}]",
        f"int[] faceVertexCounts = [{', '.join(['3'] * len(mesh.faces))}]",
        f"int[] faceVertexIndices = [{', '.join(map(str, mesh.faces.reshape(-1).tolist()))}]",
        f"normal3f[] normals = [{_tuples(normals)}] (",
        f'{INDENT}interpolation = "vertex"',
        ")",
        f"point3f[] points = [{_tuples(points)}]",
        'uniform token subdivisionScheme = "none"',
    ]
    write_text(path, _layer(['defaultPrim = "mesh"', *UP_AXIS], _prim('Mesh "mesh"', lines)))


def shader_inputs(material: Reflectance) -> dict[str, object]:
    """Inputs of UsdPreviewSurface.

    Specular workflow: F0 = specularColor = k_s, F90 = 1, diffuseColor = k_d / (1 − k_s): k_d and k_s at normal incidence.
    Without k_d a metal, whose F is diffuseColor = k_s at every angle.
    """
    diffuse, specular = np.array(material.diffuse, dtype=float), np.array(material.specular, dtype=float)
    roughness = with_roughness_of_file(material).roughness
    if specular.any() and not diffuse.any():
        return {"diffuseColor": specular, "metallic": 1.0, "roughness": roughness, "useSpecularWorkflow": 0}
    base = np.divide(diffuse, 1 - specular, out=np.zeros(3), where=specular < 1)
    return {"diffuseColor": base, "roughness": roughness, "specularColor": specular, "useSpecularWorkflow": 1}


def with_roughness_of_file(material: Reflectance) -> Reflectance:
    """Without k_s the roughness is free: at 1 the Fresnel term, which cannot be left out, shows least."""
    return material if any(material.specular) else msgspec.structs.replace(material, roughness=1.0)


def identifiers(names: Iterable[str]) -> dict[str, str]:
    """An identifier of its own for every name: letters, digits and _ of ASCII, not beginning with a digit.

    >>> identifiers(["red-1", "red_1", "2", ""])
    {'red_1': 'red_1', 'red-1': 'red_1_2', '2': '_2', '': '_'}
    """
    found: dict[str, str] = {}
    for name in sorted(dict.fromkeys(names), key=lambda name: _identifier(name) != name):
        number, first = 1, _identifier(name)
        found_name = first
        while found_name in found.values():
            number += 1
            found_name = f"{first}_{number}"
        found[name] = found_name
    return found


def _identifier(name: str) -> str:
    plain = re.sub(r"[^A-Za-z0-9_]", "_", name)
    return plain if plain and not plain[0].isdigit() else f"_{plain}"


# parts of a scene ----------------------------------------------------------------------------------------------------


def _camera(view: View, shapes: Sequence[Shape]) -> list[str]:
    (cx, cy), (w, h), pixel = view.principal_point, (view.width, view.height), FILM / view.width
    numbers = {
        "focalLength": view.focal_px * pixel,
        "horizontalAperture": w * pixel,
        "horizontalApertureOffset": (w / 2 - cx) * pixel,
        "verticalAperture": h * pixel,
        "verticalApertureOffset": (cy - h / 2) * pixel,
    }
    lines = [f"float2 clippingRange = {_tuple(clip_distances(shapes))}", 'token projection = "perspective"']
    return _prim('Camera "camera"', [*lines, *(f"float {name} = {_number(value)}" for name, value in numbers.items())])


def _light(light: ExposedMap) -> list[str]:
    """exposure = intensity · color."""
    intensity = float(light.exposure.max())
    colour = light.exposure / intensity if intensity > 0 else np.ones(3)
    turn = np.eye(4)
    turn[:3, :3] = YUP_FROM_CAMERA @ light.camera_from_light @ YUP_FROM_CAMERA
    lines = [
        f"color3f inputs:color = {_tuple(colour)}",
        f"float inputs:intensity = {_number(intensity)}",
        f"asset inputs:texture:file = {_asset(light.file)}",
        'token inputs:texture:format = "latlong"',
    ]
    return _prim('DomeLight "light"', [*lines, *_transform(turn)])


def _materials(materials: Mapping[str, Reflectance], named: Mapping[str, str]) -> list[str]:
    lines = [line for name, identifier in named.items() for line in _material(name, identifier, materials[name])]
    return _prim('Scope "materials"', lines)


def _material(name: str, identifier: str, material: Reflectance) -> list[str]:
    shader = ['uniform token info:id = "UsdPreviewSurface"']
    for key, value in shader_inputs(material).items():
        kind = "color3f" if np.ndim(value) else "int" if isinstance(value, int) else "float"
        words = {"color3f": _tuple, "int": str, "float": _number}[kind](value)
        shader.append(f"{kind} inputs:{key} = {words}")
    surface = f"token outputs:surface.connect = </scene/materials/{identifier}/surface.outputs:surface>"
    lines = [surface, *_prim('Shader "surface"', [*shader, "token outputs:surface"])]
    return _prim(f'Material "{identifier}"', lines, _shown(name))


def _objects(shapes: Sequence[Shape], materials: Mapping[str, str]) -> list[str]:
    """A Xform per object, and in it a mesh per material."""
    objects: dict[str, list[Shape]] = {}
    for shape in shapes:
        objects.setdefault(shape.name.removesuffix(f".{shape.material}"), []).append(shape)
    lines = []
    for name, identifier in identifiers(objects).items():
        place = np.eye(4)
        place[:3, :3] = YUP_FROM_CAMERA
        parts = [line for shape in objects[name] for line in _part(shape, materials[shape.material])]
        about = [*_transform(place @ objects[name][0].cam_from_object), *parts]
        lines += _prim(f'Xform "{identifier}"', about, _shown(name))
    return _prim('Scope "objects"', lines)


def _part(shape: Shape, material: str) -> list[str]:
    file = f"./{PurePosixPath(shape.file).with_suffix(SUFFIX)}"
    binding, references = 'prepend apiSchemas = ["MaterialBindingAPI"]', f"prepend references = {_asset(file)}"
    about = [binding, *_shown(shape.material), references]
    return _prim(f'Mesh "{material}"', [f"rel material:binding = </scene/materials/{material}>"], about)


def _transform(matrix: Float[np.ndarray, "4 4"]) -> list[str]:
    """A matrix for columns, as USD's for rows."""
    rows = ", ".join(_tuple(row) for row in matrix.T)
    return [f"matrix4d xformOp:transform = ({rows})", 'uniform token[] xformOpOrder = ["xformOp:transform"]']


# text ----------------------------------------------------------------------------------------------------------------


def _layer(about: Sequence[str], lines: Sequence[str]) -> str:
    return "\n".join(["#usda 1.0", "(", *_indented(about), ")", "", *lines, ""])


def _prim(head: str, lines: Sequence[str], about: Sequence[str] = ()) -> list[str]:
    opened = [f"def {head} (", *_indented(about), ")"] if about else [f"def {head}"]
    return [*opened, "{", *_indented(lines), "}"]


def _indented(lines: Sequence[str]) -> list[str]:
    return [INDENT + line for line in lines]


def _shown(name: str) -> list[str]:
    return [f"displayName = {_string(name)}"]


def _string(text: str) -> str:
    plain = {c: c if c.isprintable() or ord(c) >= 128 else f"\\x{ord(c):02x}" for c in text} | ESCAPES
    return '"' + "".join(plain[c] for c in text) + '"'


def _asset(path: str) -> str:
    return f"@{path}@" if "@" not in path else f"@@@{path.replace('@@@', chr(92) + '@@@')}@@@"


def _number(value: float) -> str:
    return repr(float(value) + 0.0)


def _tuple(values: Iterable[float]) -> str:
    return f"({', '.join(_number(value) for value in values)})"


def _tuples(rows: Float[np.ndarray, "n 3"]) -> str:
    """Nine digits, which tell all float32 apart."""
    return ", ".join(["(%.9g, %.9g, %.9g)"] * len(rows)) % tuple(rows.reshape(-1).tolist())
