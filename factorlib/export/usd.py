"""Export of a photo's scene as OpenUSD text, written without a USD library and byte for byte reproducible.

    /scene/camera, light, materials/<material>, objects/<object>/<material>;  /Render/photo: the size in pixels

Frame     The frame of `factorlib.export.exported_scene`, in the poses' units; the camera looks along −z, as every USD
          camera does.  USD multiplies row vectors from the left, so matrices are written transposed.
Camera    Apertures are fractions of FILM; their offset is the picture's middle, right of and above the principal point.
Light     A dome light's map has OpenEXR's layout, as the exported maps have it.
Material  UsdPreviewSurface: GGX of α = roughness², Schlick's F from F0 to F90, diffuseColor × (1 − F) per channel
          (`shader_inputs`).
Texture   A painted part has a material of its own, whose diffuseColor is the part's image of k_d (sRGB), times
          1 / (1 − k_s).
Meshes    A file for each part of one material, beside the PLY file, to which scenes refer.
Names     Every prim has the name from the data set as displayName.  Its identifier is that name if USD allows it
          (`identifiers`).
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from itertools import chain, count
from pathlib import Path, PurePosixPath

import msgspec
import numpy as np
from jaxtyping import Float

from factorlib.export.exported_scene import ExportedScene, ExportedShape, ExposedMap
from factorlib.meshes.mesh import Mesh
from factorlib.results.materials import Reflectance
from factorlib.wholefile import write_text

# Width of the film in tenths of a unit, 36 mm if a unit is a metre.  Only its ratio to the focal length matters.
FILM = 0.36
SUFFIX = ".usda"
INDENT = "    "
UP_AXIS = ["metersPerUnit = 1", 'upAxis = "Y"']  # The size of a unit of the poses in metres is unknown.
ESCAPES = {"\\": "\\\\", '"': '\\"', "\n": "\\n", "\r": "\\r", "\t": "\\t"}


def write_usd_scene(path: str | Path, scene: ExportedScene) -> None:
    """Write a photo's scene with the materials that its shapes name.

    It refers to the files that `write_usd_mesh` writes beside the shapes' own.
    """
    named = identifiers(sorted({_look(shape) for shape in scene.shapes}))
    parts = [*_camera(scene), *_light(scene.light), *_materials(scene, named), *_objects(scene.shapes, named)]
    size = f"uniform int2 resolution = ({scene.camera.width}, {scene.camera.height})"
    settings = _prim('RenderSettings "photo"', ["rel camera = </scene/camera>", size])
    about = ['defaultPrim = "scene"', UP_AXIS[0], 'renderSettingsPrimPath = "/Render/photo"', UP_AXIS[1]]
    write_text(path, _layer(about, [*_prim('Xform "scene"', parts), *_prim('Scope "Render"', settings)]))


def write_usd_mesh(path: str | Path, mesh: Mesh) -> None:
    """Write a mesh as the prim /mesh in its own frame and units, as float32 and without a material.

    Its texture coordinates, if it has any, are the primvar `st`.
    """
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
    if mesh.uv is not None:
        lines += [f"texCoord2f[] primvars:st = [{_tuples(mesh.uv)}] (", f'{INDENT}interpolation = "vertex"', ")"]
    write_text(path, _layer(['defaultPrim = "mesh"', *UP_AXIS], _prim('Mesh "mesh"', lines)))


def shader_inputs(material: Reflectance) -> dict[str, float | np.ndarray]:
    """Return the inputs of UsdPreviewSurface.

    The specular workflow has F0 = specularColor = k_s, F90 = 1 and diffuseColor = k_d / (1 − k_s), which gives k_d and
    k_s at normal incidence.  A material without k_d is a metal, whose F is diffuseColor = k_s at every angle.
    """
    diffuse = np.array(material.diffuse, dtype=float)
    specular = np.array(material.specular, dtype=float)
    roughness = with_roughness_of_file(material).roughness
    if specular.any() and not diffuse.any():
        return {"diffuseColor": specular, "metallic": 1.0, "roughness": roughness, "useSpecularWorkflow": 0}
    base = np.divide(diffuse, 1 - specular, out=np.zeros(3), where=specular < 1)
    return {"diffuseColor": base, "roughness": roughness, "specularColor": specular, "useSpecularWorkflow": 1}


def with_roughness_of_file(material: Reflectance) -> Reflectance:
    """Return the material with the roughness that is written to the USD file.

    Without k_s the roughness is free.  It is set to 1, where the Fresnel term, which UsdPreviewSurface cannot omit, is
    least visible.
    """
    return material if any(material.specular) else msgspec.structs.replace(material, roughness=1.0)


def identifiers(names: Iterable[str]) -> dict[str, str]:
    """Return a distinct identifier for every name: ASCII letters, digits and _, not beginning with a digit.

    >>> identifiers(["red-1", "red_1", "2", ""])
    {'red_1': 'red_1', 'red-1': 'red_1_2', '2': '_2', '': '_'}
    """
    plain = {name: re.sub(r"^(?=[0-9]|$)", "_", re.sub(r"[^A-Za-z0-9_]", "_", name)) for name in names}
    distinct: dict[str, str] = {}
    for name in sorted(plain, key=lambda name: plain[name] != name):
        choices = chain([plain[name]], (f"{plain[name]}_{number}" for number in count(2)))
        distinct[name] = next(each for each in choices if each not in distinct.values())
    return distinct


# parts of a scene ----------------------------------------------------------------------------------------------------


def _camera(scene: ExportedScene) -> list[str]:
    camera = scene.camera
    pixel = FILM / camera.width
    cx, cy = camera.centre
    numbers = {
        "focalLength": camera.focal * pixel,
        "horizontalAperture": camera.width * pixel,
        "horizontalApertureOffset": (camera.width / 2 - cx) * pixel,
        "verticalAperture": camera.height * pixel,
        "verticalApertureOffset": (cy - camera.height / 2) * pixel,
    }
    lines = [f"float2 clippingRange = {_tuple(scene.clip_distances)}", 'token projection = "perspective"']
    return _prim('Camera "camera"', [*lines, *(f"float {name} = {_number(value)}" for name, value in numbers.items())])


def _light(light: ExposedMap) -> list[str]:
    """Return a dome light whose intensity · color is the exposure."""
    intensity = float(light.exposure.max())
    colour = light.exposure / intensity if intensity > 0 else np.ones(3)
    lines = [
        f"color3f inputs:color = {_tuple(colour)}",
        f"float inputs:intensity = {_number(intensity)}",
        f"asset inputs:texture:file = {_asset(light.file)}",
        'token inputs:texture:format = "latlong"',
    ]
    return _prim('DomeLight "light"', [*lines, *_transform(light.world_from_light)])


def _look(shape: ExportedShape) -> str:
    """Return the name of a shape's material in the scene; each painted part has its own."""
    return f"{shape.material} ({PurePosixPath(shape.file).stem})" if shape.image else shape.material


def _materials(scene: ExportedScene, named: Mapping[str, str]) -> list[str]:
    lines = []
    shapes = {_look(shape): shape for shape in scene.shapes}
    for name, identifier in named.items():
        shader = ['uniform token info:id = "UsdPreviewSurface"']
        path = f"/scene/materials/{identifier}"
        inputs = shader_inputs(scene.materials[shapes[name].material])
        textured = shapes[name].image and inputs["useSpecularWorkflow"] == 1  # a metal has no k_d
        for key, value in inputs.items():
            if key == "diffuseColor" and textured:
                shader.append(f"color3f inputs:{key}.connect = <{path}/texture.outputs:rgb>")
            elif isinstance(value, np.ndarray):
                shader.append(f"color3f inputs:{key} = {_tuple(value)}")
            elif isinstance(value, int):
                shader.append(f"int inputs:{key} = {value}")
            else:
                shader.append(f"float inputs:{key} = {_number(value)}")
        surface = f"token outputs:surface.connect = <{path}/surface.outputs:surface>"
        about = [surface, *_prim('Shader "surface"', [*shader, "token outputs:surface"])]
        if textured:
            about += _texture(path, shapes[name], scene.materials[shapes[name].material])
        lines += _prim(f'Material "{identifier}"', about, _display_name(name))
    return _prim('Scope "materials"', lines)


def _texture(path: str, shape: ExportedShape, material: Reflectance) -> list[str]:
    """Return the shaders that look up diffuseColor, k_d / (1 − k_s), in a painted shape's image of k_d."""
    specular = np.array(material.specular)
    scale = np.divide(1, 1 - specular, out=np.zeros(3), where=specular < 1)
    texture = [
        'uniform token info:id = "UsdUVTexture"',
        f"asset inputs:file = {_asset(f'./{shape.image}')}",
        f"float4 inputs:scale = {_tuple([*scale, 1.0])}",
        'token inputs:sourceColorSpace = "sRGB"',
        f"float2 inputs:st.connect = <{path}/coordinates.outputs:result>",
        'token inputs:wrapS = "clamp"',
        'token inputs:wrapT = "clamp"',
        "float3 outputs:rgb",
    ]
    read = ['uniform token info:id = "UsdPrimvarReader_float2"', 'string inputs:varname = "st"']
    return [*_prim('Shader "texture"', texture), *_prim('Shader "coordinates"', [*read, "float2 outputs:result"])]


def _objects(shapes: Sequence[ExportedShape], materials: Mapping[str, str]) -> list[str]:
    """Return an Xform per object, and in it a mesh per material."""
    objects: dict[str, list[ExportedShape]] = {}
    for shape in shapes:
        objects.setdefault(shape.name.removesuffix(f".{shape.material}"), []).append(shape)
    lines = []
    for name, identifier in identifiers(objects).items():
        about = _transform(objects[name][0].world_from_object)
        for shape in objects[name]:
            material = materials[_look(shape)]
            file = PurePosixPath(shape.file).with_suffix(SUFFIX)
            references = f"prepend references = {_asset(f'./{file}')}"
            head = ['prepend apiSchemas = ["MaterialBindingAPI"]', *_display_name(shape.material), references]
            about += _prim(f'Mesh "{material}"', [f"rel material:binding = </scene/materials/{material}>"], head)
        lines += _prim(f'Xform "{identifier}"', about, _display_name(name))
    return _prim('Scope "objects"', lines)


def _transform(matrix: Float[np.ndarray, "4 4"]) -> list[str]:
    """Return a matrix for column vectors in USD's row-vector convention."""
    rows = ", ".join(_tuple(row) for row in matrix.T)
    return [f"matrix4d xformOp:transform = ({rows})", 'uniform token[] xformOpOrder = ["xformOp:transform"]']


# text ----------------------------------------------------------------------------------------------------------------


def _layer(about: Sequence[str], lines: Sequence[str]) -> str:
    return "\n".join(["#usda 1.0", "(", *_indent(about), ")", "", *lines, ""])


def _prim(head: str, lines: Sequence[str], about: Sequence[str] = ()) -> list[str]:
    opened = [f"def {head} (", *_indent(about), ")"] if about else [f"def {head}"]
    return [*opened, "{", *_indent(lines), "}"]


def _indent(lines: Sequence[str]) -> list[str]:
    return [INDENT + line for line in lines]


def _display_name(name: str) -> list[str]:
    plain = {c: c if c.isprintable() or ord(c) >= 128 else f"\\x{ord(c):02x}" for c in name} | ESCAPES
    return ['displayName = "' + "".join(plain[c] for c in name) + '"']


def _asset(path: str) -> str:
    return f"@{path}@" if "@" not in path else f"@@@{path.replace('@@@', chr(92) + '@@@')}@@@"


def _number(value: float) -> str:
    return repr(float(value) + 0.0)


def _tuple(values: Iterable[float]) -> str:
    return f"({', '.join(_number(value) for value in values)})"


def _tuples(rows: Float[np.ndarray, "n c"]) -> str:
    """Format rows with nine digits, which distinguish all float32."""
    row = f"({', '.join(['%.9g'] * rows.shape[1])})"
    return ", ".join([row] * len(rows)) % tuple(rows.reshape(-1).tolist())
