"""Mesh files: what is kept, what is dropped, what is refused; what is odd but legal is read whole, the same in every format."""

from __future__ import annotations

import logging

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from factorlib.errors import InputError
from factorlib.meshes.limits import Limits
from factorlib.meshes.mesh import area_vectors
from factorlib.meshes.ply import submesh, write_ply
from factorlib.meshes.read import read_mesh
from tests.faults.sample import DATA, MESHES, OFF, PLY, PLY_FACES, PLY_TEXT, STL_TEXT, VERTICES, glb, gltf_header, put

MATERIALS = ["red", "oak"]
PARTS = {"shell": "red", "legs": "oak"}
QUADS = "".join(f"v {x} {y} {z}\n" for z in (0, 1) for x, y in ((0, 0), (1, 0), (1, 1), (0, 1)))
QUADS += """
g shell
usemtl plastic
f 4 3 2 1
f 5 6 7 8
f 1 2 6 5
g legs
usemtl wood
f 2 3 7 6
f 3 4 8 7
f -8 -4 -1 -5
"""


def obj(tmp_path, text):
    return put(tmp_path / "mesh.obj", text)


def read_all(path, content):
    return read_mesh(put(path, content), MATERIALS, "red")


def area_of(mesh, label):
    return np.linalg.norm(area_vectors(mesh.vertices, mesh.faces[mesh.face_label == label]), axis=1).sum()


@pytest.mark.parametrize(
    "parts", [{"shell": "red", "legs": "oak"}, {"plastic": "red", "wood": "oak"}, {"shell": "red", "wood": "oak"}]
)
def test_obj_parts_go_by_group_or_usemtl_without_a_material_file(tmp_path, parts):
    mesh = read_mesh(obj(tmp_path, QUADS), MATERIALS, parts)
    assert len(mesh.faces) == 12  # quads and negative indices
    assert area_of(mesh, 1) == pytest.approx(3) and area_of(mesh, 2) == pytest.approx(3)
    assert not mesh.open


@pytest.mark.parametrize("parts, words, cure", [
    ({"shell": "red"}, "legs.*no material", "legs: red|wood: red"),
    ({"shel": "red", "legs": "oak"}, "no part 'shel'", "did you mean 'shell'?"),
    ({"shell": "red", "plastic": "oak", "legs": "oak"}, "several materials", "one of its names only"),
    ({"shell": "red", "legs": "ok"}, "unknown material 'ok'", "did you mean 'oak'?"),
])  # fmt: skip
def test_parts_and_materials_that_do_not_fit_are_named(tmp_path, parts, words, cure):
    with pytest.raises(InputError, match=words) as caught:
        read_mesh(obj(tmp_path, QUADS), MATERIALS, parts)
    assert "mesh.obj" in str(caught.value) and any(each in caught.value.cure for each in cure.split("|"))


def test_bad_faces_are_dropped_with_a_note(tmp_path, caplog):
    with caplog.at_level(logging.INFO, "factorlib.meshes"):
        mesh = read_mesh(obj(tmp_path, QUADS + "f 1 2 2\nf 4 3 2\nf 2 3 4\n"), MATERIALS, PARTS)
    assert len(mesh.faces) == 12  # 4 3 2 is half of the first quad, in either winding
    assert "1 zero-area" in caplog.text and "2 duplicate" in caplog.text


def test_glb_nodes_are_placed_and_parts_named(tmp_path):
    scene = trimesh.Scene()
    for name, material, shift in (("seat", "plastic", 0.0), ("leg", "wood", 3.0)):
        box = trimesh.creation.box((1, 1, 1))
        box.visual = trimesh.visual.TextureVisuals(material=trimesh.visual.material.PBRMaterial(name=material))
        scene.add_geometry(box, geom_name=name, transform=trimesh.transformations.translation_matrix((shift, 0, 0)))
    scene.export(tmp_path / "chair.glb")
    for parts in ({"seat": "red", "leg": "oak"}, {"plastic": "red", "wood": "oak"}):
        mesh = read_mesh(tmp_path / "chair.glb", MATERIALS, parts)
        oak = mesh.vertices[np.unique(mesh.faces[mesh.face_label == 2])]
        assert np.allclose(oak.mean(axis=0), (3, 0, 0)) and mesh.labels == (1, 2)


def test_written_ply_is_read_again_and_is_the_same_bytes_and_a_submesh_holds_one_material(tmp_path):
    mesh = read_mesh(obj(tmp_path, QUADS), MATERIALS, PARTS)
    for name in ("a.ply", "b.ply"):
        write_ply(tmp_path / name, mesh)
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()
    again = read_mesh(tmp_path / "a.ply", MATERIALS, "red")
    corners = [sorted(map(tuple, np.round(m.vertices[m.faces].reshape(-1, 9), 6))) for m in (mesh, again)]
    assert corners[0] == corners[1]
    parts = [submesh(mesh, label) for label in mesh.labels]
    assert sum(len(p.faces) for p in parts) == 12 and all(p.faces.max() == len(p.vertices) - 1 for p in parts)


def test_gltf_nodes_lie_in_each_other_scaled_then_turned_then_moved(tmp_path):
    turn, header, outer = Rotation.from_euler("xyz", [0.3, -0.8, 1.1]), gltf_header(), np.eye(4)
    outer[:3, 3] = (5, 6, 7)
    header["nodes"] = [
        {"matrix": outer.T.ravel().tolist(), "children": [1]},
        {"mesh": 0, "scale": [1, 2, 3], "rotation": turn.as_quat().tolist(), "translation": [1, 0, 0]},
    ]
    (tmp_path / "a.glb").write_bytes(glb(header))
    expected = turn.apply(VERTICES * (1, 2, 3)) + (6, 6, 7)
    found = np.unique(read_mesh(tmp_path / "a.glb", MATERIALS, "red").vertices.round(5), axis=0)
    assert np.allclose(found, np.unique(expected.round(5), axis=0), atol=2e-5)


@pytest.mark.parametrize("suffix", ["ply", "glb"])
def test_normals_of_the_file_are_used(tmp_path, suffix):
    ball = trimesh.creation.icosphere(subdivisions=1)
    tilted = ball.vertex_normals + 0.2 * np.roll(ball.vertex_normals, 1, axis=1)
    tilted /= np.linalg.norm(tilted, axis=1, keepdims=True)
    made = trimesh.Trimesh(ball.vertices, ball.faces, vertex_normals=tilted, process=False)
    options = {"vertex_normal": True} if suffix == "ply" else {}
    (tmp_path / f"ball.{suffix}").write_bytes(made.export(file_type=suffix, **options))
    mesh = read_mesh(tmp_path / f"ball.{suffix}", MATERIALS, "red")
    nearest = np.argmin(np.linalg.norm(mesh.vertices[:, None] - ball.vertices, axis=2), axis=1)
    assert np.allclose(mesh.normals, tilted[nearest], atol=1e-5)


@pytest.mark.parametrize("name", MESHES)
def test_the_tetrahedron_is_the_same_in_every_format_and_no_larger_than_allowed(tmp_path, name):
    path = put(tmp_path / name, MESHES[name])
    mesh = read_mesh(path, MATERIALS, "red", limits=Limits(triangles=4))
    assert len(mesh.faces) == 4 and not mesh.open and mesh.radius == pytest.approx(0.75**0.5)
    with pytest.raises(InputError, match="4 triangles") as caught:
        read_mesh(path, MATERIALS, "red", limits=Limits(triangles=3))
    assert "simplify" in caught.value.cure


def test_gltf_strips_and_repeated_primitives_are_read_and_fans_and_sparse_accessors_refused(tmp_path):
    header = gltf_header()
    header["accessors"][1]["count"] = 4
    header["meshes"][0]["primitives"][0]["mode"] = 5
    data = DATA[:48] + np.array([0, 1, 2, 3], "<u2").tobytes().ljust(24, b"\0")
    assert len(read_all(tmp_path / "a.glb", glb(header, data)).faces) == 2
    header["meshes"][0]["primitives"][0]["mode"] = 6
    assert not trimesh_faces(glb(header, data), "glb")
    with pytest.raises(InputError, match="triangle fan"):
        read_all(tmp_path / "a.glb", glb(header, data))
    header = gltf_header()
    indices, values = {"bufferView": 1, "componentType": 5121}, {"bufferView": 0}
    header["accessors"][0]["sparse"] = {"count": 1, "indices": indices, "values": values}
    with pytest.raises(InputError, match="sparse accessor"):
        read_all(tmp_path / "a.glb", glb(header))
    header = gltf_header()
    header["meshes"][0]["primitives"] *= 3
    header["nodes"] = [{"children": [1, 2]}, {"mesh": 0}, {"mesh": 0, "translation": [3, 0, 0]}]
    assert len(read_all(tmp_path / "a.glb", glb(header)).faces) == 8


def test_gltf_positions_of_normalized_integers_are_fractions(tmp_path):
    header = gltf_header()
    header["accessors"][0] |= {"componentType": 5123, "normalized": True}
    header["bufferViews"][0] |= {"byteStride": 12}
    data = np.pad((VERTICES * 65535).astype("<u2"), ((0, 0), (0, 3))).tobytes() + DATA[48:]
    assert read_all(tmp_path / "a.glb", glb(header, data)).vertices.max() == 1


def trimesh_faces(content: bytes, kind: str) -> int:
    scene = trimesh.load_scene(trimesh.util.wrap_as_stream(content), file_type=kind)
    return sum(len(mesh.faces) for mesh in scene.geometry.values())


def binary_ply_of(*polygons):
    faces = b"".join(bytes([len(polygon)]) + np.array(polygon, "<i4").tobytes() for polygon in polygons)
    return PLY[: -len(PLY_FACES)].replace(b"face 4", b"face %d" % len(polygons)) + faces


SQUARE_AND_TWO = ((0, 1, 3, 2), (0, 1, 2), (1, 2, 3))
CUT = {"a.off": OFF[:-8], "a.ply": PLY_TEXT[:-8], "a.stl": STL_TEXT + STL_TEXT[:-40]}


@pytest.mark.parametrize("name", CUT)
def test_a_truncated_text_is_refused_that_trimesh_reads_as_a_smaller_mesh(tmp_path, name):
    assert trimesh_faces(CUT[name].encode(), name[2:]) in (3, 4)
    with pytest.raises(InputError):
        read_all(tmp_path / name, CUT[name])


def test_polygons_of_different_lengths_in_a_binary_ply_are_read_which_trimesh_refuses(tmp_path):
    with pytest.raises(ValueError, match="unexpected length"):
        trimesh_faces(binary_ply_of(*SQUARE_AND_TWO), "ply")
    assert len(read_all(tmp_path / "a.ply", binary_ply_of(*SQUARE_AND_TWO)).faces) == 4


def test_names_of_obj_groups_are_read_which_trimesh_drops():
    scene = trimesh.load_scene(trimesh.util.wrap_as_stream(QUADS), file_type="obj")
    assert not {"shell", "legs"} & {*scene.geometry, *scene.graph.nodes}
