"""Meshes: what is read of files and what is refused, smooth normals, and subdivision."""

import logging
import re
import struct

import numpy as np
import pytest
import trimesh

from factorlib.meshes.mesh import Mesh, area_vectors, corner_normals, find_flipped_faces
from factorlib.meshes.ply_stl_off import submesh, write_ply
from factorlib.meshes.read_mesh import merged_normals, read_mesh, usable
from factorlib.meshes.subdivision import subdivide, subdivided_mesh
from factorlib.meshes.triangle_soup import Limits, TriangleSoup, triangulate
from tests.faults import sample
from tests.faults.sample import MESHES, OFF, STL_TEXT, glb, put
from tests.refusal import refusal

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


def read_all(path, content):
    return read_mesh(put(path, content), MATERIALS, "red")


def area_of(mesh, label):
    return np.linalg.norm(area_vectors(mesh.vertices, mesh.faces[mesh.face_label == label]), axis=1).sum()


@pytest.mark.parametrize(
    "parts",
    [
        {"shell": "red", "legs": "oak"},
        {"plastic": "red", "wood": "oak"},
        {"shell": "red", "wood": "oak"},
        {"mesh": "red", "legs": "oak"},
    ],
)
def test_obj_parts_go_by_group_or_usemtl_or_else_by_the_file_without_a_material_file(tmp_path, parts):
    content = QUADS.replace("g shell\nusemtl plastic", "") if "mesh" in parts else QUADS
    mesh = read_mesh(put(tmp_path / "mesh.obj", content), MATERIALS, parts)
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
    caught = refusal(words, read_mesh, put(tmp_path / "mesh.obj", QUADS), MATERIALS, parts)
    assert "mesh.obj" in str(caught) and any(each in caught.cure for each in cure.split("|"))


def test_bad_faces_are_dropped_with_a_note(tmp_path, caplog):
    with caplog.at_level(logging.INFO, "factorlib.meshes"):
        mesh = read_mesh(put(tmp_path / "mesh.obj", QUADS + "f 1 2 2\nf 4 3 2\nf 2 3 4\n"), MATERIALS, PARTS)
    assert len(mesh.faces) == 12  # 4 3 2 is half of the first quad, in either winding
    assert "1 zero-area" in caplog.text and "2 duplicate" in caplog.text


@pytest.mark.parametrize("part", ["chair", "shell", "red"])
def test_parts_of_a_glb_go_by_node_or_mesh_or_material(tmp_path, part):
    assert read_mesh(put(tmp_path / "a.glb", glb()), MATERIALS, {part: "oak"}).labels == (2,)


def test_written_ply_is_read_again_and_a_submesh_holds_one_material(tmp_path):
    mesh = read_mesh(put(tmp_path / "mesh.obj", QUADS), MATERIALS, PARTS)
    write_ply(tmp_path / "a.ply", mesh)
    again = read_mesh(tmp_path / "a.ply", MATERIALS, "red")
    corners = [sorted(map(tuple, np.round(m.vertices[m.faces].reshape(-1, 9), 6))) for m in (mesh, again)]
    assert corners[0] == corners[1]
    parts = [submesh(mesh, label) for label in mesh.labels]
    assert sum(len(p.faces) for p in parts) == 12 and all(p.faces.max() == len(p.vertices) - 1 for p in parts)


@pytest.mark.parametrize("suffix", ["ply", "glb"])
def test_normals_of_the_file_are_used(tmp_path, suffix):
    ball = trimesh.creation.icosphere(subdivisions=1)
    tilted = ball.vertex_normals + 0.2 * np.roll(ball.vertex_normals, 1, axis=1)
    tilted /= np.linalg.norm(tilted, axis=1, keepdims=True)
    built = trimesh.Trimesh(ball.vertices, ball.faces, vertex_normals=tilted, process=False)
    options = {"vertex_normal": True} if suffix == "ply" else {}
    (tmp_path / f"ball.{suffix}").write_bytes(built.export(file_type=suffix, **options))
    mesh = read_mesh(tmp_path / f"ball.{suffix}", MATERIALS, "red")
    nearest = np.argmin(np.linalg.norm(mesh.vertices[:, None] - ball.vertices, axis=2), axis=1)
    assert np.allclose(mesh.normals, tilted[nearest], atol=1e-5)


@pytest.mark.parametrize("name", MESHES)
def test_the_tetrahedron_is_the_same_in_every_format_and_no_larger_than_allowed(tmp_path, name):
    path = put(tmp_path / name, MESHES[name])
    mesh = read_mesh(path, MATERIALS, "red", limits=Limits(triangles=4))
    assert len(mesh.faces) == 4 and not mesh.open and mesh.radius == pytest.approx(0.75**0.5)
    assert "simplify" in refusal("4 triangles", read_mesh, path, MATERIALS, "red", limits=Limits(triangles=3)).cure


# ── what a file means: its triangles, or the words with which it is refused ──────────────────────────────────────────

SQUARE = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1, 0)], "<f4")
CORNER = SQUARE[:3]
HALVES = [(0, 1, 2), (2, 1, 3)]  # corners of SQUARE
COMPONENTS = {"|i1": 5120, "|u1": 5121, "<i2": 5122, "<u2": 5123, "<f4": 5126}


def a_glb(*arrays, primitive=(), mesh=(), node=(), accessor=(), view=(), **header) -> bytes:
    """A mesh whose positions are the first array; integers in columns are fractions."""
    types = ["SCALAR" if each.ndim == 1 else f"VEC{each.shape[1]}" for each in arrays]
    accessors = [
        {"bufferView": k, "componentType": COMPONENTS[each.dtype.str], "count": len(each), "type": kind,
         "normalized": kind != "SCALAR" and each.dtype != "f4"} for k, (each, kind) in enumerate(zip(arrays, types))
    ]  # fmt: skip
    views = [{"buffer": 0, "byteOffset": 99 * k, "byteLength": 99} for k in range(len(arrays))]
    data = b"".join(each.tobytes().ljust(99, b"\0") for each in arrays)
    parts = {
        "asset": {"version": "2.0"},
        "buffers": [{"byteLength": len(data)}],
        "bufferViews": [views[0] | dict(view), *views[1:]],
        "accessors": [accessors[0] | dict(accessor), *accessors[1:]],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}} | dict(primitive)]} | dict(mesh)],
        "nodes": [{"mesh": 0} | dict(node)],
    }
    return glb(parts | header, data)


def ply_of(rows: str, *elements: str) -> str:
    """A PLY of SQUARE, and of further elements, whose rows are lists."""
    lists = "".join(f"element {each}\nproperty list int int vertex_indices\n" for each in elements)
    return (
        sample.PLY_HEADER.format("ascii").split("element face")[0]
        + lists
        + "end_header\n0 0 0\n1 0 0\n0 1 0\n1 1 0\n"
        + rows
    )


MOVES = np.array([(5, 0, 0), (0, 5, 0)], "<f4")
TURNS = np.array([(0, 0, 0, 127), (0, 0, 90, 90)], "i1")  # by 0 and 90 degrees about z
SIZES = np.array([(1, 1, 1), (-2, 1, 1)], "<f4")  # the second is a mirror image
PLACES = {"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": 1, "ROTATION": 2, "SCALE": 3}}}
POINTS = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\n"
UNREAD = ["KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_meshopt_compression", "MSFT_lod", "ACME_shape"]
# what, its format and content -> triangles, as corners of SQUARE or as points, or a regular expression of the refusal
MEANING = [
    *((f"{name}.glb", a_glb(CORNER, extensionsRequired=[name]), f"requires {name}.*again without {name}") for name in UNREAD),
    ("paint.glb", a_glb(CORNER, extensionsRequired=["KHR_materials_ior", "KHR_texture_basisu"]), HALVES[:1]),
    ("draco alone.glb", a_glb(CORNER, extensionsUsed=UNREAD[:1], accessor={"bufferView": None}), "no data.*without KHR_draco"),
    ("no fallback.glb", a_glb(CORNER, extensionsUsed=UNREAD[1:2], buffers=[{"byteLength": 512}]), "states 512.*without EXT_meshopt"),
    ("sparse.glb", a_glb(CORNER, accessor={"sparse": {"count": 1, "indices": {"bufferView": 0, "componentType": 5121}, "values": {"bufferView": 0}}}), "without sparse accessors"),
    ("skin.glb", a_glb(CORNER, node={"skin": 0}), r"nodes\[0\] is posed by a skin.*apply the armature"),
    ("morph.glb", a_glb(CORNER, mesh={"weights": [0, 0.5]}), "morph targets"),
    ("no morph.glb", a_glb(CORNER, mesh={"weights": [1]}, node={"weights": [0]}), HALVES[:1]),
    ("instances.glb", a_glb(CORNER, MOVES, TURNS, SIZES, node={"extensions": PLACES, "scale": [1, 1, 2], "translation": [0, 0, 3]}),
     [[(-1, 5, 3), (0, 3, 3), (0, 5, 3)], [(5, 0, 3), (6, 0, 3), (5, 1, 3)]]),
    ("unequal.glb", a_glb(CORNER, MOVES, TURNS[:1], SIZES, node={"extensions": PLACES}), r"accessors\[2\] has 1 "),
    ("nested.glb", a_glb(CORNER, nodes=[{"matrix": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 5, 6, 7, 1], "children": [1]},
     {"mesh": 0, "scale": [2, 3, 1], "rotation": [0, 0, 1, 1], "translation": [1, 0, 0]}]), [[(3, 6, 7), (6, 6, 7), (6, 8, 7)]]),
    ("mirrored.glb", a_glb(CORNER, node={"scale": [-1, 1, 1]}), [[(-1, 0, 0), (0, 0, 0), (0, 1, 0)]]),
    ("strip.glb", a_glb(SQUARE, np.arange(4, dtype="u1"), primitive={"mode": 5, "indices": 1}), HALVES),
    ("fan.glb", a_glb(SQUARE[[0, 1, 3, 2]], primitive={"mode": 6}), [(0, 1, 3), (0, 3, 2)]),
    ("quantized.glb", a_glb((CORNER * 4).astype("<i2"), accessor={"normalized": False}, node={"scale": [0.25] * 3},
                            extensionsRequired=["KHR_mesh_quantization"]), HALVES[:1]),
    ("fractions.glb", a_glb(np.pad((CORNER * 32767).astype("<i2"), ((0, 0), (0, 3))), accessor={"type": "VEC3"}, view={"byteStride": 12}), HALVES[:1]),
    ("padded.glb", a_glb(CORNER, zeros="\0").replace(b', "zeros": "\\u0000"}', b"}" + bytes(19)), HALVES[:1]),
    ("beyond.glb", a_glb(CORNER, primitive={"attributes": {"POSITION": 9}}), r"refers to accessors\[9\], but has 1 accessors"),
    ("short.glb", a_glb(CORNER, accessor={"count": 9}), r"accessors\[0\] needs 108 bytes of a buffer view, which has 99"),
    ("matrix.glb", a_glb(CORNER, node={"matrix": [1]}), r"length >= 16 - at `\$.nodes\[0\].matrix`"),
    ("older.gltf", '{"asset": {"version": "1.0"}, "buffers": {}}', "is glTF 1.0.*as glTF 2.0"),
    ("strips.ply", ply_of("8 0 1 2 3 3 -1 1 3\n3 1 3 2\n", "tristrips 2"), HALVES),
    ("both.ply", ply_of("3 0 1 2\n3 1 3 2\n", "face 1", "tristrips 1"), HALVES),
    ("lengths.ply", sample.PLY_HEADER.format("binary_little_endian").replace("face 4", "face 2").encode() + SQUARE.tobytes()
     + struct.pack("<B2iB4i", 2, 0, 1, 4, 0, 1, 3, 2), [(0, 1, 3), (0, 3, 2)]),
    ("cut.ply", ply_of("3 0 1 2\n3 1 3", "face 2"), "a row has fewer numbers"),
    ("surface.obj", POINTS + "f 1 2 3\nsurf 0 1 0 1 1 2 3 4\n", "line 6.*free-form"),
    ("other file.obj", POINTS + "f 1 2 3\ncall b.obj\n", "line 6.*included files"),
    ("utf16.obj", (POINTS + "f 1 2 3\n").encode("utf-16"), HALVES[:1]),
    ("old face.obj", POINTS + "f 1 2 3\nfo 2 4 3\n", HALVES),
    ("comment.obj", "# of C:\\things\\\n" + POINTS + "f 1 2 \\\n3\n", HALVES[:1]),
    ("corners.stl", STL_TEXT.replace("vertex 1.0 0.0 0.0", "vertex 1.0", 1), "11 corners of 4 facets"),
    ("twice.stl", STL_TEXT + STL_TEXT[:-40], "23 corners of 7 facets"),
    ("spaced.stl", "\n".join(["facet", *(f"vertex {x:g} {y:g} 0" for x, y, _ in CORNER), "end facet"]), HALVES[:1]),
    ("cut.off", OFF[:-8], "ends in the middle"),
]  # fmt: skip


@pytest.mark.parametrize("name, content, meaning", MEANING, ids=[name for name, *_ in MEANING])
def test_a_file_is_read_as_its_format_defines_or_refused_by_name(tmp_path, name, content, meaning):
    if isinstance(meaning, str):
        error = refusal(".", read_all, tmp_path / name, content)
        assert re.search(meaning, f"{error.fault} {error.cure}"), str(error)
        return
    mesh = read_all(tmp_path / name, content)
    wanted = [(SQUARE[list(each)] if np.ndim(each) == 1 else np.array(each)).tolist() for each in meaning]
    corners = mesh.vertices[mesh.faces].round(2)
    assert sorted(np.roll(each, -np.lexsort(each.T[::-1])[0], axis=0).tolist() for each in corners) == sorted(wanted)


# an L, whose fan about any corner but two leaves it, with the numbers of colours behind its row
CORNERS = [(2, 0, 0), (2, 1, 0), (1, 1, 0), (1, 2, 0), (0, 2, 0), (0, 0, 0)]
ROWS = "".join("{} {} {}\n".format(*corner) for corner in CORNERS) + "6 0 1 2 3 4 5 6 0 0 0 0 0 0 9 1 1 1\n"
ELL = {
    "a.obj": "".join("v {} {} {}\n".format(*corner) for corner in CORNERS) + "f 1 2 3 4 5 6",
    "a.off": "OFF\n6 1 0\n" + ROWS,
    "a.ply": sample.PLY_HEADER.format("ascii").replace("x 4", "x 6").replace("e 4", "e 1") + ROWS,
    "b.ply": sample.PLY_HEADER.format("binary_little_endian").replace("x 4", "x 6").replace("e 4", "e 1").encode()
    + np.array(CORNERS, "<f4").tobytes() + b"\6" + np.arange(6, dtype="<i4").tobytes(),
}  # fmt: skip


@pytest.mark.parametrize("name", ELL)
def test_a_concave_polygon_has_its_own_area_and_what_a_row_holds_beyond_the_header_is_no_part_of_it(tmp_path, name):
    mesh = read_all(tmp_path / name, ELL[name])
    assert len(mesh.faces) == 4 and area_of(mesh, 1) == pytest.approx(3)
    assert np.abs(mesh.normals[:, 2]).min() == pytest.approx(1) and np.ptp(mesh.normals[:, 2]) == 0


def test_a_star_is_filled_by_as_many_triangles_as_any_polygon_of_its_corners():
    turn = np.arange(40) * np.pi / 20
    star = np.stack([np.cos(turn), np.sin(turn), 0.3 * np.cos(turn)], 1) * np.where(np.arange(40) % 2, 1, 0.3)[:, None]
    sizes, corners = np.array([3, 40, 4]), np.concatenate([[0, 2, 4], np.arange(40), [1, 3, 5, 7]])
    triangles = corners[triangulate(star, sizes, corners)]
    assert triangles[0].tolist() == [0, 2, 4] and triangles[-2:].tolist() == [[1, 3, 5], [1, 5, 7]]
    area = area_vectors(star, triangles[1:-2]) @ (-0.3, 0, 1)
    assert len(area) == 38 and area.min() > 0
    assert area.sum() == pytest.approx(1.09 * 40 * 0.15 * np.sin(np.pi / 20))


def test_names_of_obj_keep_their_hash_and_a_comment_is_still_one(tmp_path):
    named = (
        QUADS.replace("plastic", "Material #1")
        .replace("usemtl wood", "usemtl Material #2 # legs\n#")
        .replace("6 5", "6 5#")
    )
    mesh = read_mesh(put(tmp_path / "mesh.obj", named), MATERIALS, {"Material #1": "red", "Material #2": "oak"})
    assert area_of(mesh, 1) == pytest.approx(3) and area_of(mesh, 2) == pytest.approx(3)


# ── Smooth normals: exact on a sphere, sharp at creases, indifferent to duplicates, winding and tessellation ────────


def usable_mesh(vertices, faces, crease_deg=60.0):
    faces = np.asarray(faces)
    supplied = np.full((len(faces), 3, 3), np.nan)
    soup = TriangleSoup(np.asarray(vertices, float), faces, np.zeros(len(faces), int), [("a",)], supplied)
    return usable(soup, np.ones(len(faces), int), crease_deg, "m")


def test_a_cube_is_sharp_or_rounded_by_the_crease_angle_and_angles_not_triangle_counts_weigh():
    box = trimesh.creation.box((1, 1, 1))
    sharp, smooth = usable_mesh(box.vertices, box.faces), usable_mesh(box.vertices, box.faces, crease_deg=100)
    assert len(sharp.vertices) == 24 and np.allclose(np.abs(sharp.normals).max(axis=1), 1)
    round_ = smooth.vertices / np.linalg.norm(smooth.vertices, axis=1, keepdims=True)
    assert len(smooth.vertices) == 8 and np.allclose(smooth.normals, round_)
    mesh = usable_mesh(*trimesh.remesh.subdivide(box.vertices, box.faces, face_index=[0, 1]), crease_deg=100)
    corner = np.argmin(np.linalg.norm(mesh.vertices - 0.5, axis=1))  # of a side that is cut into many triangles
    assert np.allclose(mesh.normals[corner], 1 / np.sqrt(3))


def test_a_sphere_is_smooth_whether_its_triangles_share_vertices_or_not():
    ball = trimesh.creation.icosphere(subdivisions=3)
    soup = ball.triangles.reshape(-1, 3) + np.random.default_rng(0).normal(size=(len(ball.faces) * 3, 3)) * 1e-9
    split, shared = usable_mesh(soup, np.arange(len(soup)).reshape(-1, 3)), usable_mesh(ball.vertices, ball.faces)
    assert len(split.vertices) == len(shared.vertices) == len(ball.vertices)  # no crease: every vertex once
    assert np.rad2deg(np.arccos(np.sum(shared.normals * shared.vertices, axis=1).min())) < 0.6
    assert np.allclose(np.sort(split.normals @ [1, 2, 3]), np.sort(shared.normals @ [1, 2, 3]), atol=1e-6)


def test_flipped_faces_are_turned_back_unless_most_of_an_open_patch_is():
    ball = trimesh.creation.icosphere(subdivisions=2)
    faces = ball.faces.copy()
    faces[::3] = faces[::3, ::-1]
    for flipped in (faces, ball.faces[:, ::-1]):
        mesh = usable_mesh(ball.vertices, flipped)
        assert np.sum(mesh.normals * mesh.vertices, axis=1).min() > 0.99
    bowl = ball.faces[ball.triangles_center[:, 2] > 0][:, ::-1]  # inward, on purpose
    flip, is_open = find_flipped_faces(ball.vertices, bowl)
    assert is_open and not flip.any()


def test_supplied_normals_are_used_where_sane():
    ball = trimesh.creation.icosphere(subdivisions=1)
    exact = ball.vertices[ball.faces]
    spoilt = exact.copy()
    spoilt[0], spoilt[1] = -exact[0], 0.0
    own = corner_normals(ball.vertices, ball.faces, 60.0)
    merged = merged_normals(own, spoilt, ball.face_normals)
    assert np.allclose(merged[2:], exact[2:]) and np.allclose(merged[:2], own[:2])


# ── Subdivided meshes: closed meshes stay closed, gradients are exact, and a displacement is found again from the tur


def labelled_mesh(solid: trimesh.Trimesh, factors=(1.0, 1.0, 1.0)) -> Mesh:
    """A trimesh with smooth normals of its own, two labels and stretched axes."""
    vertices = np.array(solid.vertices) * factors
    label = 1 + (np.arange(len(solid.faces)) % 3 == 0).astype(np.int16)
    normals = trimesh.Trimesh(vertices, solid.faces, process=False).vertex_normals
    return Mesh(vertices, np.array(solid.faces, np.int32), np.array(normals), label)


def ball(subdivisions: int = 2, factors=(1.0, 1.0, 1.0)) -> Mesh:
    """An icosphere of radius 1, its axes times `factors`."""
    return labelled_mesh(trimesh.creation.icosphere(subdivisions), factors)


SOLIDS = {
    "box": labelled_mesh(trimesh.creation.box((1, 0.3, 0.07))),
    "cone": labelled_mesh(trimesh.creation.cone(0.2, 1.0, sections=9)),
    "ball": ball(1),
}


@pytest.mark.parametrize("name", SOLIDS)
@pytest.mark.parametrize("longest", [0.5, 0.11, 0.05])
def test_a_closed_mesh_stays_closed_and_keeps_its_area_its_labels_and_its_winding(name, longest):
    mesh = SOLIDS[name]
    dense = subdivide(mesh, longest)
    ends = dense.vertices[np.stack([dense.faces, np.roll(dense.faces, -1, axis=1)])]
    assert np.linalg.norm(ends[0] - ends[1], axis=-1).max() <= longest
    edges = np.stack([dense.faces, np.roll(dense.faces, -1, axis=1)], axis=-1).reshape(-1, 2)
    assert len(np.unique(edges, axis=0)) == len(
        edges
    )  # no edge twice in one direction: as closed and as wound as before
    assert np.array_equal(np.unique(edges, axis=0), np.unique(edges[:, ::-1], axis=0))
    before, after = (area_vectors(of.vertices, of.faces) for of in (mesh, dense))
    for label in mesh.labels:  # vectors: areas, and directions too
        sums = [of[m.face_label == label].sum(0) for of, m in ((before, mesh), (after, dense))]
        areas = [np.linalg.norm(of[m.face_label == label], axis=1).sum() for of, m in ((before, mesh), (after, dense))]
        np.testing.assert_allclose(*sums, atol=1e-12)
        np.testing.assert_allclose(*areas)


def test_a_displacement_is_found_from_the_turns_that_it_means():
    body = subdivided_mesh(ball(3))
    place = np.zeros((body.nodes, 3))
    place[body.node] = body.mesh.vertices / body.extent
    waves = 0.02 * np.sin(7 * place @ [1.0, 0.5, 0.2]) * np.cos(5 * place[:, 1])
    result = body.displacement(body.normal_change(waves), np.ones(body.nodes))
    assert np.std(result - waves) < 0.05 * np.std(waves)


def test_the_two_sides_of_a_thin_disc_do_not_cross():
    body = subdivided_mesh(ball(4, (1.0, 1.0, 0.03)))
    inward = body.displace(np.full(body.nodes, -0.02))  # each side by more than the half thickness of 0.015
    facing = np.abs(body.mesh.normals[:, 2]) > 0.9
    front = np.sign(body.mesh.normals[facing, 2])
    before, after = (front * mesh.vertices[facing, 2] for mesh in (body.mesh, inward))
    assert (after > 0).all() and (after < before).all()
    outward = body.displace(np.full(body.nodes, 0.02))
    np.testing.assert_allclose(np.linalg.norm(outward.vertices - body.mesh.vertices, axis=1), 0.02 * body.extent)
