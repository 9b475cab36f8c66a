"""Image textures of painted meshes: the image at a vertex has the vertex's colour, in every format that refers to it."""

import xml.etree.ElementTree as ET

import msgspec
import numpy as np
import pytest
import trimesh
from scipy.ndimage import map_coordinates
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from factorlib.export import simplification
from factorlib.export.materialx import materialx
from factorlib.export.mitsuba import headroom_factor, paint_range
from factorlib.export.simplification import MOST_ERROR, Surface, simplify
from factorlib.export.texture_atlas import make_atlas
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
from tests.stages.made import ran


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
    "fine ball": trimesh.creation.icosphere(4),
    "torus": trimesh.creation.torus(1.0, 0.3, 60, 30),
    "box": trimesh.creation.box((1.0, 0.3, 0.02)),
}


def charts_of(mesh: Mesh) -> int:
    """The number of connected pieces of a mesh with texture coordinates, over vertices."""
    edges = np.vstack([mesh.faces[:, :2], mesh.faces[:, 1:]])
    graph = coo_array((np.ones(len(edges)), edges.T), shape=(len(mesh.vertices),) * 2)
    return connected_components(graph, directed=False)[0]


@pytest.mark.parametrize("name", MESHES)
def test_image_has_each_vertex_colour_and_every_face_a_place_in_few_charts(name):
    mesh = painted(MESHES[name])
    atlas = make_atlas([mesh], mesh, 0.005 * np.ptp(mesh.vertices, axis=0).max())
    result = atlas.mesh
    assert result.uv.min() >= 0 and result.uv.max() <= 1 and charts_of(result) <= 20
    np.testing.assert_array_equal(mesh.vertices[mesh.faces], result.vertices[result.faces])
    u, v = np.moveaxis(result.uv[result.faces], -1, 0)
    area = (u[:, 1] - u[:, 0]) * (v[:, 2] - v[:, 0]) - (v[:, 1] - v[:, 0]) * (u[:, 2] - u[:, 0])
    assert (np.abs(area) > 1e-9).all() and np.abs(area).sum() / 2 < 1
    image = atlas.bake(mesh, np.ones((1, 3)))
    assert image.min() > 0 and (atlas.bake(mesh, np.full((1, 3), 9.0)) == 255).all()  # nothing of the background
    np.testing.assert_allclose(colours_at(image, result.uv), waves(result.vertices), atol=0.04)
    middles = result.uv[result.faces].mean(1), waves(mesh.vertices)[mesh.faces].mean(1)
    np.testing.assert_allclose(colours_at(image, middles[0]), middles[1], atol=0.04)


def test_texels_are_no_wider_than_a_pixel():
    mesh = painted(MESHES["torus"])
    for pixel in (0.02, 0.005):
        atlas = make_atlas([mesh], mesh, pixel)
        uv, place = (
            values[atlas.mesh.faces] for values in (np.pad(atlas.mesh.uv, [(0, 0), (0, 1)]), atlas.mesh.vertices)
        )
        flat, solid = (np.linalg.norm(np.cross(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]), axis=1) for t in (uv, place))
        texel = np.sqrt(solid / flat) / len(atlas.face)
        assert solid[texel <= pixel].sum() > 0.94 * solid.sum() and np.median(texel) > pixel / 2


def test_surfaces_that_are_no_manifold_and_many_parts_are_laid_out():
    balls = [trimesh.creation.icosphere(1).apply_translation([3 * k, 0, 0]) for k in range(20)]
    for vertices, faces in (
        (np.vstack([np.zeros(3), np.eye(3), [0, -1, 0]]), np.array([[0, 1, 2], [0, 1, 3], [0, 1, 4]])),
        (np.vstack([b.vertices for b in balls]), np.vstack([b.faces + 42 * k for k, b in enumerate(balls)])),
        (np.random.default_rng(0).normal(size=(300, 3)), np.arange(300).reshape(100, 3)),  # loose triangles
    ):
        mesh = smooth(vertices, faces)
        atlas = make_atlas([mesh], mesh, 0.01 * np.ptp(vertices, axis=0).max())
        assert len(np.unique(atlas.face)) > 0.9 * len(faces)


def test_simplified_surfaces_are_near_and_keep_borders_of_materials_and_creases(monkeypatch):
    """A ball of two materials, with a wavy border, and a box whose edges are sharp."""
    ball = trimesh.creation.icosphere(5)
    x, y, z = ball.triangles_center.T
    label = np.where(z > 0.2 * np.sin(5 * np.arctan2(y, x)), 2, 1)
    mesh = smooth(np.asarray(ball.vertices), ball.faces, label)
    assert simplify(mesh).faces is mesh.faces or len(mesh.faces) > simplification.MOST_TRIANGLES
    monkeypatch.setattr(simplification, "MOST_TRIANGLES", 9000)
    result = simplify(mesh)
    assert len(result.faces) <= 9000
    for a, b in ((mesh, result), (result, mesh)):
        points = np.vstack([a.vertices, a.vertices[a.faces].mean(1)])
        distance = Surface(b.vertices, b.faces).nearest(points)[2]
        assert distance.max() <= 1.05 * MOST_ERROR * 2
    places = [border_places(each) for each in (mesh, result)]
    np.testing.assert_array_equal(*places)
    assert trimesh.Trimesh(result.vertices, result.faces).is_watertight
    np.testing.assert_allclose(np.sum(result.normals * result.vertices, axis=1), 1, atol=2e-3)
    # creases
    box = trimesh.creation.box((1, 1, 1)).subdivide_loop(0).subdivide().subdivide().subdivide().subdivide().subdivide()
    corners = box.vertices[box.faces].reshape(-1, 3)
    sharp = Mesh(
        corners,
        np.arange(len(corners)).reshape(-1, 3),
        np.repeat(box.face_normals, 3, 0),
        np.ones(len(box.faces), np.int16),
    )
    result = simplify(sharp)
    assert len(result.faces) <= 9000
    np.testing.assert_allclose(np.abs(result.normals).max(axis=1), 1, atol=1e-6)


def border_places(mesh: Mesh) -> np.ndarray:
    """The middles of the edges between labels, in order."""
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces)
    a, b = solid.face_adjacency.T
    edges = solid.face_adjacency_edges[mesh.face_label[a] != mesh.face_label[b]]
    return np.unique(np.round(solid.vertices[edges].mean(1), 5), axis=0)


def test_paint_above_one_moves_the_gauge_and_is_counted():
    material = Reflectance((0.8, 0.4, 0.2), (0.1, 0.1, 0.1), 0.5)
    ball = painted(MESHES["fine ball"])
    bright = msgspec.structs.replace(ball, detail=np.where(ball.vertices[:, :1] > 0, 1.5, 0.5) * np.ones(3))
    paint = paint_range(material, [bright])
    assert paint.above == pytest.approx(0.5, abs=0.02) and paint.brightest == pytest.approx(1.5 * 0.9)
    assert headroom_factor({"a": material}, {"a": paint}) == pytest.approx((1 - 1e-5) / (1.5 * 0.9))
    # one bright node is no reason
    spot = msgspec.structs.replace(
        ball, detail=np.where(np.arange(len(ball.vertices)) == 5, 9.0, 1.0)[:, None] * np.ones(3)
    )
    assert (
        paint_range(material, [spot]).brightest < 1
        and headroom_factor({"a": material}, {"a": paint_range(material, [spot])}) == 1
    )


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
        ran(export, inputs, root / name, silent, height=32, mitsuba_height=32)
    return root


def test_painted_parts_have_images_and_the_others_the_bytes_of_plain_ones(folder, exported):
    files, plain = files_of(folder / "export"), files_of(exported[1])
    assert files == files_of(folder / "again")
    assert {"scenes/meshes/egg.png"} == {f for f in files if f.endswith(".png")}
    for name in ("ball.glb", "meshes/ball.ply", "scenes/meshes/ball.red.ply"):
        assert files[name] == plain[name]


def test_every_format_looks_the_reflectance_up_in_the_same_image(folder):
    out = folder / "export"
    material = read_materials(out / "materials.json").materials["red"]
    # glTF: a texture of the base colour
    part = trimesh.load(out / "egg.glb").geometry["red"]
    colours = colours_at(np.asarray(part.visual.material.baseColorTexture), part.visual.uv)
    base = waves(part.vertices) * material.diffuse / (1 - max(material.specular))
    inner = part.vertices[:, 1] > 0.15  # beside the border the image goes over into brass
    np.testing.assert_allclose(colours[inner], base[inner], atol=0.06)
    # Blender: texture coordinates of the vertices, Mitsuba: colours
    heads = [
        (out / f"scenes/meshes/egg.red{end}").read_bytes().partition(b"end_header")[0]
        for end in (".ply", ".vertices.ply")
    ]
    assert b"float s\nproperty float t\n" in heads[0] and b"red" not in heads[0]
    assert b"float red" in heads[1] and "egg.red.vertices.ply" in (out / "scenes/side.xml").read_text()
    assert '"image": "meshes/egg.png"' in (out / "scenes/side.json").read_text()
    assert "image" not in (out / "scenes/front.json").read_text()
    root = ET.fromstring((out / "materials.mtlx").read_text())
    assert [each.get("value") for each in root.iterfind("image/input")] == 2 * ["scenes/meshes/egg.png"]


@pytest.mark.long
def test_blender_shows_the_image_as_mitsuba_shows_the_vertices(folder):
    agree(folder / "align", folder / "export/scenes", ["side"])


def test_materialx_multiplies_the_image_to_the_constant_that_it_replaces():
    material = Reflectance((0.4, 0.2, 0.1), (0.1, 0.2, 0.3), 0.5)
    root = ET.fromstring(materialx({"red": material}, {"scenes/meshes/a.png": ["red"]}))
    nodes = {node.get("name"): {each.get("name"): each.attrib for each in node} for node in root}
    prefix = "m_red__a"
    for end, key in (("diffuse", "color"), ("standard_surface_surface", "base_color")):
        source = nodes[f"{prefix}_{end}"][key]["nodename"]
        factor, constant = nodes[source]["in2"]["value"], nodes[f"m_red_{end}"][key]["value"].split(",")
        np.testing.assert_allclose(float(factor) * np.array(material.diffuse), np.array(constant, float))
        assert nodes[source]["in1"]["nodename"] == f"{prefix}_image"
    plain = materialx({"red": material})
    assert "image" not in plain and plain.removesuffix("</materialx>\n") in materialx(
        {"red": material}, {"a.png": ["red"]}
    )
