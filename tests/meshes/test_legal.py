"""Meshes that are odd but legal are read whole, the same in every format; what is larger than the limits of a mesh is refused."""

import time

import numpy as np
import pytest

from factorlib.errors import InputError
from factorlib.meshes import read_mesh
from factorlib.meshes.limits import Limits
from tests.faults.good import DATA, FACES, MESHES, OBJ, OFF, PLY_HEADER, STL_TEXT, VERTICES, glb, gltf_header, put

MATERIALS = ["red"]


def read(path, content):
    return read_mesh(put(path, content), MATERIALS, "red")


@pytest.mark.parametrize("name", MESHES)
def test_the_tetrahedron_is_the_same_in_every_format_and_no_larger_than_allowed(tmp_path, name):
    path = put(tmp_path / name, MESHES[name])
    mesh = read_mesh(path, MATERIALS, "red", limits=Limits(triangles=4))
    assert len(mesh.faces) == 4 and not mesh.open and mesh.radius == pytest.approx(0.75**0.5)
    with pytest.raises(InputError, match="4 triangles") as caught:
        read_mesh(path, MATERIALS, "red", limits=Limits(triangles=3))
    assert "simplify" in caught.value.cure


def test_a_part_with_a_latin_1_name_can_be_named(tmp_path):
    path = put(tmp_path / "a.obj", OBJ.replace("red", "stühle").encode("latin-1"))
    assert read_mesh(path, MATERIALS, {"stühle": "red"}).labels == (1,)


def test_triangles_and_quads_may_be_mixed_in_ply_and_off(tmp_path):
    """A pyramid on a square, in text and both byte orders."""
    vertices = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 0.5, 1]])
    faces = [[3, 2, 1, 0], [0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]]
    header = PLY_HEADER.replace("vertex 4", "vertex 5").replace("face 4", "face 5")
    rows = "".join(f"{' '.join(map(str, row))}\n" for row in [*vertices.tolist(), *([len(f), *f] for f in faces)])
    contents = {"a.ply": header.format("ascii") + rows, "a.off": f"OFF 5 5 0\n{rows}"}
    for order, word in (("<", "little"), (">", "big")):
        polygons = b"".join(bytes([len(f)]) + np.array(f, f"{order}i4").tobytes() for f in faces)
        binary = header.format(f"binary_{word}_endian").encode() + vertices.astype(f"{order}f4").tobytes()
        contents[f"{word}.ply"] = binary + polygons
    for name, content in contents.items():
        mesh = read(tmp_path / name, content)
        assert len(mesh.faces) == 6 and not mesh.open, name


def test_gltf_strips_fans_sparse_accessors_and_repeated_primitives_are_read(tmp_path):
    header = gltf_header()
    header["accessors"][1]["count"] = 4
    for mode in (5, 6):
        header["meshes"][0]["primitives"][0]["mode"] = mode
        data = DATA[:48] + np.array([0, 1, 2, 3], "<u2").tobytes().ljust(24, b"\0")
        assert len(read(tmp_path / "a.glb", glb(header, data)).faces) == 2
    header = gltf_header()
    indices, values = {"bufferView": 2, "componentType": 5121}, {"bufferView": 3}
    header["accessors"][0]["sparse"] = {"count": 1, "indices": indices, "values": values}
    header["bufferViews"] += [
        {"buffer": 0, "byteOffset": at, "byteLength": length} for at, length in ((72, 1), (76, 12))
    ]
    header["buffers"][0]["byteLength"] = 88
    data = DATA + b"\3\0\0\0" + np.array([0, 0, 5], "<f4").tobytes()
    assert read(tmp_path / "a.glb", glb(header, data)).vertices[:, 2].max() == 5
    header = gltf_header()
    header["meshes"][0]["primitives"] *= 3
    header["nodes"] = [{"children": [1, 2]}, {"mesh": 0}, {"mesh": 0, "translation": [3, 0, 0]}]
    assert len(read(tmp_path / "a.glb", glb(header)).faces) == 8


def test_a_normal_of_any_length_does_no_harm(tmp_path):
    plain = read(tmp_path / "a.obj", OBJ.replace("vn 0 0 1", "vn 0 0 0"))
    for normal in ("1e300 0 1", "nan 0 1", "inf inf 1"):
        odd = read(tmp_path / "a.obj", OBJ.replace("vn 0 0 1", f"vn {normal}"))
        assert np.array_equal(plain.normals, odd.normals)


@pytest.mark.parametrize("scale", [1e-9, 1e9])
def test_any_honest_unit_is_read(tmp_path, scale):
    text = OBJ
    for vertex in VERTICES:
        text = text.replace("v {} {} {}\n".format(*vertex), "v {!r} {!r} {!r}\n".format(*(vertex * scale).tolist()))
    mesh = read(tmp_path / "a.obj", text)
    assert mesh.radius == pytest.approx(scale * 0.75**0.5) and len(mesh.faces) == len(FACES)


@pytest.mark.parametrize("name, text", [
    ("long", OBJ.replace("shell", "x" * 1_000_000)),
    ("many", OBJ.replace("shell", " ".join(f"part{k}" for k in range(1000)))),
    ("continued", OBJ + "g a\\\n" + "b\\\n" * 100_000),
    ("parts", OBJ + "".join(f"g part{k}\nf 1 2 3\n" for k in range(5_000))),
])  # fmt: skip
def test_many_and_long_names_of_parts_stay_cheap(tmp_path, name, text):
    path, began = put(tmp_path / f"{name}.obj", text), time.process_time()
    for parts in ({"no such": "red"}, {"chair": "rot"}):
        with pytest.raises(InputError) as caught:
            read_mesh(path, MATERIALS, parts)
        assert len(str(caught.value)) < 5000
    assert time.process_time() - began < 4


def test_more_parts_than_any_mesh_has_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("factorlib.meshes.gltf.MOST_PARTS", 1000)
    text = "v 0 0 0\nv 1 0 0\nv 0 1 0\n" + "".join(f"g {k}\nf 1 2 3\n" for k in range(1001))
    with pytest.raises(InputError, match="1,001 parts"):
        read(tmp_path / "a.obj", text)


@pytest.mark.parametrize("name, text", [
    ("polygon.off", OFF.replace("3 0 2 1", "1500000" + " 1" * 1_500_000)),
    ("vertex.stl", STL_TEXT.replace("vertex 1.0", "vertex" + " 1" * 1_500_000)),
], ids=["polygon", "vertex"])  # fmt: skip
def test_text_whose_words_would_fill_memory_is_refused(tmp_path, name, text):
    with pytest.raises(InputError, match="more than 2,000,000|has not three"):
        read(tmp_path / name, text)
