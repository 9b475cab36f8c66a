"""Image textures of painted meshes: the image at a vertex has the vertex's colour, in every format that refers to it."""

import re
import xml.etree.ElementTree as ET

import msgspec
import numpy as np
import pytest
import trimesh
from scipy.ndimage import map_coordinates

from factorlib.export import texture_atlas
from factorlib.export.materialx import materialx
from factorlib.export.texture_atlas import bake, unwrap
from factorlib.images.picture import read_png
from factorlib.images.tone import srgb_decode
from factorlib.jsonfile import write_json
from factorlib.meshes.mesh import Mesh, smooth
from factorlib.meshes.read_mesh import read_mesh
from factorlib.meshes.subdivision import subdivided_mesh
from factorlib.results.materials import Reflectance, read_materials
from factorlib.results.texture_table import FACTORS, FILE, TextureTable, write_factors
from factorlib.stage import silent
from stages import export
from tests.export import made_export
from tests.export.test_scenes import agree
from tests.runner.toy import files_of


def colours_at(image: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Linear values of an sRGB image, bilinear between texels' centres; v is upward."""
    height, width = image.shape[:2]
    places = np.stack([(1 - uv[:, 1]) * height - 0.5, uv[:, 0] * width - 0.5])
    linear = srgb_decode(image[..., :3] / 255)
    return np.stack([map_coordinates(linear[..., k], places, order=1, mode="nearest") for k in range(3)], axis=-1)


def waves(vertices: np.ndarray) -> np.ndarray:
    return 0.5 + 0.3 * np.sin(3 * vertices + vertices[:, [1, 2, 0]])


def painted(solid: trimesh.Trimesh) -> Mesh:
    vertices = np.asarray(solid.vertices)
    return msgspec.structs.replace(smooth(vertices, solid.faces), detail=waves(vertices))


MESHES = {
    "coarse ball": trimesh.creation.icosphere(1),
    "fine ball": trimesh.creation.icosphere(6),  # on which xatlas itself crashes
    "torus": trimesh.creation.torus(1.0, 0.3, 60, 30),
    "box": trimesh.creation.box((1.0, 0.3, 0.02)),
}


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.long] * (name == "fine ball")) for name in MESHES]
)
def test_image_has_each_vertex_colour_and_every_face_a_place_in_it(name):
    mesh = painted(MESHES[name])
    result = unwrap(mesh)
    assert result.uv.min() >= 0 and result.uv.max() <= 1
    for before, after in (
        (mesh.vertices, result.vertices),
        (mesh.normals, result.normals),
        (mesh.detail, result.detail),
    ):
        np.testing.assert_array_equal(before[mesh.faces], after[result.faces])
    u, v = np.moveaxis(result.uv[result.faces], -1, 0)
    area = (u[:, 1] - u[:, 0]) * (v[:, 2] - v[:, 0]) - (v[:, 1] - v[:, 0]) * (u[:, 2] - u[:, 0])
    assert (np.abs(area) > 1e-9).all() and np.abs(area).sum() / 2 < 1
    image = bake(result)
    assert image.min() > 0 and (bake(result, 9.0) == 255).all()  # nothing of the background, and values above 1 are 1
    np.testing.assert_allclose(colours_at(image, result.uv), result.detail, atol=0.04)
    middles = [each[result.faces].mean(1) for each in (result.uv, result.detail)]
    np.testing.assert_allclose(colours_at(image, middles[0]), middles[1], atol=0.04)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """An export in which the egg is painted, the ball is not."""
    root = tmp_path_factory.mktemp("painted")
    inputs = made_export.make(root)
    dense = subdivided_mesh(read_mesh(inputs.files["egg.obj"], made_export.NAMES, made_export.PARTS["egg"]))
    nodes = np.zeros((dense.nodes, 3))
    nodes[dense.node] = waves(dense.mesh.vertices)
    (root / "texture").mkdir()
    write_json(root / "texture" / FILE, TextureTable({"egg": 0.04}))
    write_factors(root / "texture" / FACTORS, {("egg", name): nodes for name in ("red", "brass")})
    inputs = msgspec.structs.replace(inputs, folders={**inputs.folders, "texture": root / "texture"})
    for name in ("export", "again"):
        (root / name).mkdir()
        export.main(export.Params(height=32, mitsuba_height=32), inputs, root / name, silent)
        texture_atlas._charts.cache_clear()
    return root


def test_painted_parts_have_images_and_the_others_the_bytes_of_plain_ones(folder, exported):
    files, plain = files_of(folder / "export"), files_of(exported[1])
    assert files == files_of(folder / "again")
    assert {f"scenes/meshes/egg.{name}.png" for name in ("red", "brass")} == {f for f in files if f.endswith(".png")}
    for name in ("ball.glb", "meshes/ball.ply", "scenes/meshes/ball.red.ply", "scenes/meshes/ball.red.usda"):
        assert files[name] == plain[name]
    assert files["scenes/front.usda"] == plain["scenes/front.usda"]


def test_every_format_looks_the_reflectance_up_in_the_same_image(folder):
    out = folder / "export"
    material = read_materials(out / "materials.json").materials["red"]
    image = read_png(out / "scenes/meshes/egg.red.png")
    # OpenUSD: st of the mesh, and the scale of the material
    mesh, scene = ((out / "scenes" / name).read_text() for name in ("meshes/egg.red.usda", "side.usda"))
    st, points = (
        np.array(re.findall(r"-?[\d.e-]+", re.search(rf"{name} = \[(.*)\]", mesh)[1]), float).reshape(-1, size)
        for name, size in (("primvars:st", 2), ("points", 3))
    )
    np.testing.assert_allclose(colours_at(image, st), waves(points) * material.diffuse, atol=0.03)
    assert "@./meshes/egg.red.png@" in scene and "displayColor" not in mesh + scene
    scale = np.array(re.findall(r"[\d.]+", re.search(r"float4 inputs:scale = \((.*), 1.0\)", scene)[1]), float)
    np.testing.assert_allclose(scale * (1 - np.array(material.specular)), 1)
    # glTF: a texture of the detail
    part = trimesh.load(out / "egg.glb").geometry["red"]
    assert np.asarray(part.visual.material.baseColorTexture).shape == image.shape
    # Mitsuba and Blender: colours and texture coordinates of the vertices
    head = (out / "scenes/meshes/egg.red.ply").read_bytes().partition(b"end_header")[0]
    assert b"float red" in head and b"float s\nproperty float t\n" in head
    assert '"image": "meshes/egg.red.png"' in (out / "scenes/side.json").read_text()
    assert "image" not in (out / "scenes/front.json").read_text()
    root = ET.fromstring((out / "materials.mtlx").read_text())
    assert {each.get("value") for each in root.iterfind("image/input")} == {
        f"scenes/meshes/egg.{name}.png" for name in ("red", "brass")
    }


@pytest.mark.long
def test_blender_shows_the_image_as_mitsuba_shows_the_vertices(folder):
    agree(folder / "align", folder / "export/scenes", ["side"])


def test_materialx_multiplies_the_image_to_the_constant_that_it_replaces():
    material = Reflectance((0.4, 0.2, 0.1), (0.1, 0.2, 0.3), 0.5)
    root = ET.fromstring(materialx({"red": material}, {"scenes/meshes/a.red.png": "red"}))
    nodes = {node.get("name"): {each.get("name"): each.attrib for each in node} for node in root}
    prefix = "m_red__a_red"
    for end, key in (("diffuse", "color"), ("standard_surface_surface", "base_color")):
        source = nodes[f"{prefix}_{end}"][key]["nodename"]
        factor, constant = nodes[source]["in2"]["value"], nodes[f"m_red_{end}"][key]["value"].split(",")
        np.testing.assert_allclose(float(factor) * np.array(material.diffuse), np.array(constant, float))
        assert nodes[source]["in1"]["nodename"] == f"{prefix}_image"
    plain = materialx({"red": material})
    assert "image" not in plain and plain.removesuffix("</materialx>\n") in materialx(
        {"red": material}, {"a.png": "red"}
    )
