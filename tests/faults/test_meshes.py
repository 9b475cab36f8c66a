"""Faults of mesh files: what is legal is read, whatever else comes is an InputError that names the file, at once and in little memory."""

from __future__ import annotations

import json
import os
import struct
import time
import tracemalloc
import warnings

import numpy as np
import pytest
from faults.mesh_files import (
    DATA,
    FACES,
    GOOD,
    OBJ,
    OFF,
    PLY,
    PLY_HEADER,
    PLY_TEXT,
    STL,
    STL_TEXT,
    VERTICES,
    glb,
    gltf_header,
    gltf_text,
    write,
)

from factorlib.errors import InputError
from factorlib.meshes import read_mesh

MATERIALS = ["red"]
MOST_MEMORY = 30_000_000  # bytes: what a file of some kB may take


def read(path):
    return read_mesh(path, MATERIALS, "red")


def refused(path, words="."):
    """The error with which the mesh at `path` is refused, in little memory."""
    tracemalloc.start()
    try:
        with warnings.catch_warnings(), pytest.raises(InputError, match=words) as caught:
            warnings.simplefilter("error")
            read(path)
        assert tracemalloc.get_traced_memory()[1] < MOST_MEMORY
    finally:
        tracemalloc.stop()
    assert str(path.name) in str(caught.value.file) and caught.value.cure and "\n" not in caught.value.found
    assert len(caught.value.found) < 400
    return caught.value


@pytest.mark.parametrize("name", GOOD)
def test_the_tetrahedron_is_the_same_in_every_format(tmp_path, name):
    mesh = read(write(tmp_path, name, GOOD[name]))
    assert len(mesh.faces) == 4 and not mesh.open and mesh.radius == pytest.approx(0.75**0.5)


# ---- legal and odd ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name, content",
    [
        ("a.obj", OBJ.replace("red", "stühle").encode("latin-1")),
        ("a.off", OFF.replace("OFF\n", "OFF\n# Möbel\n").encode("latin-1")),
        ("a.stl", STL_TEXT.replace("chair", "Stühle").encode("latin-1")),
        ("b.stl", "Möbel".encode("latin-1").ljust(80) + STL[80:]),
        ("a.ply", PLY_TEXT.replace("TextureFile a", "Möbel").encode("latin-1")),
        ("b.ply", PLY.replace(b"TextureFile a", "Möbel".encode("latin-1"))),
    ],
)
def test_latin_1_text_is_read(tmp_path, name, content):
    assert len(read(write(tmp_path, name, content)).faces) == 4


def test_a_latin_1_name_of_a_part_can_be_named(tmp_path):
    path = write(tmp_path, "a.obj", OBJ.replace("red", "stühle").encode("latin-1"))
    assert read_mesh(path, MATERIALS, {"stühle": "red"}).labels == (1,)


@pytest.mark.parametrize("uri, file", [("box%201.bin", "m/box 1.bin"), ("../buffers/b.bin", "buffers/b.bin"), ("b%C3%BC.bin", "m/bü.bin")])
@pytest.mark.parametrize("kind", ["gltf", "glb"])
def test_gltf_buffers_with_escapes_and_in_a_sibling_folder_are_read(tmp_path, uri, file, kind):
    write(tmp_path, file, DATA)
    header = json.dumps(gltf_header(uri))
    assert len(read(write(tmp_path, f"m/a.{kind}", header if kind == "gltf" else glb(header, b""))).faces) == 4


def test_triangles_and_quads_may_be_mixed_in_ply_and_off(tmp_path):
    """A pyramid on a square."""
    vertices = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 0.5, 1]])
    faces = [[3, 2, 1, 0], [0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]]
    header = PLY_HEADER.replace("vertex 4", "vertex 5").replace("face 4", "face 5")
    rows = "".join("{} {} {}\n".format(*v) for v in vertices) + "".join(f"{len(f)} {' '.join(map(str, f))}\n" for f in faces)
    binary = {}
    for order, word in (("<", "little"), (">", "big")):
        polygons = b"".join(struct.pack(f"{order}B{len(f)}i", len(f), *f) for f in faces)
        binary[f"{word}.ply"] = header.format(f"binary_{word}_endian").encode() + vertices.astype(f"{order}f4").tobytes() + polygons
    for name, content in {"a.ply": header.format("ascii") + rows, "a.off": f"OFF 5 5 0\n{rows}", **binary}.items():
        mesh = read(write(tmp_path, name, content))
        assert len(mesh.faces) == 6 and not mesh.open, name


def test_gltf_strips_fans_and_sparse_accessors_are_read(tmp_path):
    header = gltf_header()
    primitive = header["meshes"][0]["primitives"][0]
    header["accessors"][1]["count"] = 4
    for mode in (5, 6):
        primitive["mode"] = mode
        data = DATA[:48] + np.array([0, 1, 2, 3], "<u2").tobytes().ljust(24, b"\0")
        assert len(read(write(tmp_path, "a.glb", glb(header, data))).faces) == 2
    header = gltf_header()
    header["accessors"][0]["sparse"] = {"count": 1, "indices": {"bufferView": 2, "componentType": 5121}, "values": {"bufferView": 3}}
    header["bufferViews"] += [{"buffer": 0, "byteOffset": 72, "byteLength": 1}, {"buffer": 0, "byteOffset": 76, "byteLength": 12}]
    header["buffers"][0]["byteLength"] = 88
    data = DATA + b"\3\0\0\0" + np.array([0, 0, 5], "<f4").tobytes()
    assert read(write(tmp_path, "a.glb", glb(header, data))).vertices[:, 2].max() == 5


def test_the_same_gltf_is_the_same_mesh_each_time(tmp_path):
    header = gltf_header()
    header["meshes"][0]["primitives"] *= 3
    header["nodes"] = [{"children": [1, 2]}, {"mesh": 0}, {"mesh": 0, "translation": [3, 0, 0]}]
    path = write(tmp_path, "a.glb", glb(header))
    first, second = read(path), read(path)
    assert np.array_equal(first.vertices, second.vertices) and np.array_equal(first.faces, second.faces) and len(first.faces) == 8


def test_a_normal_of_any_length_does_no_harm(tmp_path):
    for normal in ("1e300 0 1", "nan 0 1", "inf inf 1", "0 0 0"):
        plain, odd = (read(write(tmp_path, "a.obj", OBJ.replace("vn 0 0 1", f"vn {words}"))) for words in ("0 0 0", normal))
        assert np.array_equal(plain.normals, odd.normals)


# ---- textures ---------------------------------------------------------------------------------------------------------


def test_a_texture_is_never_opened(tmp_path):
    os.mkfifo(tmp_path / "a.png")  # whoever opens it waits for ever
    os.mkfifo(tmp_path / "a.mtl")
    textured = {"images": [{"uri": "a.png"}, {"uri": "/dev/zero"}], "textures": [{"source": 0}]}
    textured["materials"] = [{"name": "red", "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}]
    for name, content in {**GOOD, "whole.gltf": gltf_text(**textured), "whole.glb": glb(gltf_header() | textured)}.items():
        assert len(read(write(tmp_path, name, content)).faces) == 4


@pytest.mark.parametrize("name", GOOD)
def test_a_pipe_a_folder_and_a_device_are_no_meshes(tmp_path, name):
    os.mkfifo(tmp_path / name)
    refused(tmp_path / name, "is a pipe")
    (tmp_path / f"folder{name}").mkdir()
    refused(tmp_path / f"folder{name}", "is a folder")
    (tmp_path / f"device{name}").symlink_to("/dev/zero")
    refused(tmp_path / f"device{name}", "is a device")


def test_a_pipe_is_no_gltf_buffer(tmp_path):
    os.mkfifo(tmp_path / "b.bin")
    with pytest.raises(InputError, match="is a pipe"):
        read(write(tmp_path, "a.gltf", json.dumps(gltf_header("b.bin"))))


# ---- memory and time --------------------------------------------------------------------------------------------------

HUGE = 10**12
COUNTS = {
    "vertices.ply": PLY_HEADER.format("ascii").replace("vertex 4", f"vertex {HUGE}"),
    "faces.ply": PLY.replace(b"face 4", b"face %d" % HUGE),
    "list.ply": PLY.replace(b"uchar int", b"uint int")[:-52] + b"\xff\xff\xff\xff" * 13,
    "properties.ply": PLY.replace(b"element face", b"element nothing %d\nelement face" % HUGE).replace(b"face 4", b"face 99"),
    "vertices.off": OFF.replace("4 4 0", f"{HUGE} 4 0"),
    "faces.off": OFF.replace("4 4 0", f"4 {HUGE} 0"),
    "corners.off": OFF.replace("3 0 2 1", f"{HUGE} 0 2 1"),
    "triangles.stl": STL[:80] + b"\xff" * 4 + STL[84:],
}


@pytest.mark.parametrize("name", COUNTS)
def test_counts_that_the_file_has_no_room_for_take_no_memory(tmp_path, name):
    refused(write(tmp_path, name, COUNTS[name]))


@pytest.mark.parametrize(
    "change",
    [
        {"accessors": [{"componentType": 5126, "count": HUGE, "type": "VEC3"}]},
        {"accessors": [{"bufferView": 0, "componentType": 5126, "count": HUGE, "type": "VEC3"}]},
        {"accessors": [gltf_header()["accessors"][0], {"componentType": 5125, "count": HUGE, "type": "SCALAR"}]},
        {"bufferViews": [{"buffer": 0, "byteLength": HUGE}] * 2},
        {"bufferViews": [{"buffer": 0, "byteOffset": HUGE, "byteLength": 48}] * 2},
        {"buffers": [{"byteLength": HUGE}]},
        {"nodes": [{"children": [1] * 40}] * 2},
        {"nodes": [{"children": [k + 1, k + 1]} for k in range(60)] + [{"mesh": 0}]},
        {"nodes": [{"children": [0], "mesh": 0}]},
        {"nodes": [{"mesh": 0}] * 500, "scenes": [{"nodes": list(range(500))}], "accessors": [
            gltf_header()["accessors"][0], {"componentType": 5123, "count": 99999, "type": "SCALAR"}]},
    ],
)  # fmt: skip
def test_gltf_headers_that_promise_too_much_take_no_memory(tmp_path, change):
    refused(write(tmp_path, "a.glb", glb(gltf_header() | change)))


@pytest.mark.parametrize("name", GOOD)
def test_a_huge_file_is_refused_by_its_size(tmp_path, name):
    path = write(tmp_path, name, GOOD[name])
    with open(path, "r+b") as stream:
        stream.truncate(1 << 40)  # sparse: takes no disk
    refused(path, "MB at most")


def test_a_mesh_of_too_many_triangles_is_refused(tmp_path):
    from factorlib.meshes.limits import Limits

    for name, content in GOOD.items():
        path = write(tmp_path, name, content)
        assert len(read_mesh(path, MATERIALS, "red", limits=Limits(triangles=4)).faces) == 4
        with pytest.raises(InputError, match="4 triangles") as caught:
            read_mesh(path, MATERIALS, "red", limits=Limits(triangles=3))
        assert "simplify" in caught.value.cure, name


# ---- damaged and nonsensical ------------------------------------------------------------------------------------------

DAMAGED = {
    "exponent.obj": (OBJ.replace("v 1.0", "v 1e300"), "1e\\+300"),
    "infinite.obj": (OBJ.replace("v 1.0", "v 1e999"), "not finite"),
    "index.obj": (OBJ.replace("f 1 ", f"f {'9' * 30} "), "line 10"),
    "long_index.obj": (OBJ.replace("f 1 ", f"f {'9' * 5000} "), "line 10"),
    "normal_index.obj": (OBJ.replace("//1", f"//{'9' * 30}"), "line 10"),
    "short_normal.obj": (OBJ.replace("vn 0 0 1", "vn 1"), "line 9"),
    "nan.obj": (OBJ.replace("v 1.0", "v nan"), "not finite"),
    "empty.obj": ("", "without faces"),
    "nul.obj": (b"\0" * 100, "without faces|cannot be read"),
    "flat.obj": (OBJ.replace("0.0 1.0", "0.0 0.0"), "zero area|read"),
    "point.obj": ("v 1 1 1\nv 1 1 1\nv 1 1 1\nf 1 2 3\n", "zero area"),
    "tiny.obj": (OBJ.replace("1.0", "1e-300"), "1e-300"),
    "far.obj": (OBJ.replace("v 0.0 0.0", "v 1e14 1e14").replace("v 1.0 0.0", "v 1e14 1e14"), "."),
    "nan.off": (OFF.replace("1.0", "nan"), "not finite"),
    "exponent.off": (OFF.replace("1.0", "1e300"), "1e\\+300"),
    "index.off": (OFF.replace("3 0 2 1", f"3 0 2 {'9' * 30}"), "."),
    "count.off": (OFF.replace("4 4 0", f"{'9' * 30} 4 0"), "."),
    "negative.off": (OFF.replace("4 4 0", "-4 4 0"), "."),
    "no_count.off": ("OFF", "."),
    "empty.off": ("", "."),
    "binary.off": ("OFF BINARY\n" + OFF[4:], "."),
    "nan.stl": (STL_TEXT.replace("1.0", "nan"), "not finite"),
    "short.stl": (STL_TEXT.replace("vertex 1.0 0.0 0.0", "vertex 1.0 0.0"), "."),
    "two.stl": (STL_TEXT.replace("vertex 1.0 0.0 0.0\n", "", 1), "."),
    "empty.stl": ("", "."),
    "none.stl": (STL[:80] + struct.pack("<I", 0), "without faces"),
    "nan_binary.stl": (STL.replace(struct.pack("<f", 1), struct.pack("<f", float("nan"))), "not finite"),
    "signalling_nan.stl": (STL.replace(struct.pack("<f", 1), b"\x01\x00\xa0\x7f"), "not finite"),
    "signalling_nan.ply": (PLY.replace(struct.pack("<f", 1), b"\x01\x00\xa0\x7f"), "not finite"),
    "signalling_nan.glb": (glb(data=DATA.replace(struct.pack("<f", 1), b"\x01\x00\xa0\x7f")), "not finite"),
    "cut.stl": (STL[:-1], "."),
    "empty.ply": ("", "."),
    "no_end.ply": (PLY_HEADER.format("ascii").replace("end_header\n", ""), "."),
    "cut.ply": (PLY[:-1], "."),
    "cut_text.ply": (PLY_TEXT[:-9], "."),
    "words.ply": (PLY_TEXT.replace("3 0 2 1", "3 0 two 1"), "."),
    "negative.ply": (PLY_TEXT.replace("vertex 4", "vertex -4"), "."),
    "long_type.ply": (PLY_TEXT.replace("float x", f"{'9' * 5000} x"), "."),
    "long_format.ply": (PLY_TEXT.replace("ascii", "9" * 5000), "."),
    "no_type.ply": (PLY_TEXT.replace("float x", "real x"), "."),
    "no_x.ply": (PLY_TEXT.replace("float x", "float w"), "."),
    "twice.ply": (PLY_TEXT.replace("float y", "float x"), "."),
    "no_faces.ply": (PLY_TEXT.replace("element face 4", "element face 0"), "."),
    "points.ply": (PLY_TEXT.split("element face")[0] + "end_header\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n", "without faces"),
    "list_of_floats.ply": (PLY_TEXT.replace("uchar int", "float float").replace("3 0 2 1", "3 0 2.5 1"), "."),
    "index.ply": (PLY_TEXT.replace("3 0 2 1", "3 0 2 99999999999999999999999999"), "."),
    "nan.ply": (PLY.replace(struct.pack("<f", 1), struct.pack("<f", float("nan"))), "not finite"),
    "exponent.ply": (PLY_TEXT.replace("float", "double").replace("1.0\n", "1e300\n"), "."),
    "empty.gltf": ("", "."),
    "deep.gltf": ('{"extras": ' + "[" * 100_000 + "]" * 100_000 + "}", "nested too deeply"),
    "array.gltf": ("[]", "."),
    "latin.gltf": (gltf_text().replace("shell", "stühle").encode("latin-1"), "."),
    "draco.gltf": (gltf_text(extensionsRequired=["KHR_draco_mesh_compression"]), "compress"),
    "empty.glb": (b"", "."),
    "cut.glb": (glb()[:-1], "."),
    "short.glb": (glb()[:9], "."),
    "chunk.glb": (glb()[:12] + b"\xff\xff\xff\x7f" + glb()[16:], "."),
    "no_bin.glb": (glb()[:20], "."),
    "old.glb": (struct.pack("<III", 0x46546C67, 1, 20) + b"\0" * 8, "."),
    "nan.glb": (glb(data=DATA.replace(struct.pack("<f", 1), struct.pack("<f", float("nan")))), "not finite"),
    "deep.glb": (glb("[" * 100_000), "."),
}  # fmt: skip


@pytest.mark.parametrize("name", DAMAGED)
def test_a_damaged_mesh_is_refused(tmp_path, name):
    content, words = DAMAGED[name]
    refused(write(tmp_path, name, content), words)


HEADERS = {
    "null buffers": {"buffers": None},
    "null": {"meshes": None},
    "uri of 5": {"buffers": [{"byteLength": 72, "uri": 5}]},
    "uri with NUL": {"buffers": [{"byteLength": 72, "uri": "a%00b"}]},
    "long uri": {"buffers": [{"byteLength": 72, "uri": "a" * 300}]},
    "circle": {"buffers": [{"byteLength": 72, "uri": "circle"}]},
    "nothing there": {"buffers": [{"byteLength": 72, "uri": "gone.bin"}]},
    "damaged data uri": {"buffers": [{"byteLength": 72, "uri": "data:;base64,!!!"}]},
    "web address": {"buffers": [{"byteLength": 72, "uri": "http://x/y.bin"}]},
    "no accessors": {"accessors": []},
    "negative count": {"accessors": [{"bufferView": 0, "componentType": 5126, "count": -1, "type": "VEC3"}]},
    "no such type": {"accessors": [{"bufferView": 0, "componentType": 7, "count": 4, "type": "VEC3"}]},
    "no such view": {"accessors": [{"bufferView": 9, "componentType": 5126, "count": 4, "type": "VEC3"}]},
    "no such buffer": {"bufferViews": [{"buffer": 7, "byteLength": 48}] * 2},
    "no such mesh": {"nodes": [{"mesh": 7}]},
    "no such node": {"scenes": [{"nodes": [7]}]},
    "no such scene": {"scene": 7},
    "short matrix": {"nodes": [{"mesh": 0, "matrix": [1, 2]}]},
    "huge scale": {"nodes": [{"mesh": 0, "scale": [1e300, 1e300, 1e300]}]},
    "no rotation": {"nodes": [{"mesh": 0, "rotation": [0, 0, 0, 0]}]},
    "no position": {"meshes": [{"primitives": [{"attributes": {}}]}]},
    "points": {"meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "mode": 0}]}]},
    "version": {"asset": {"version": "1.0"}},
}


@pytest.mark.parametrize("name", HEADERS)
@pytest.mark.parametrize("kind", ["gltf", "glb"])
def test_a_damaged_gltf_header_is_refused(tmp_path, name, kind):
    (tmp_path / "circle").symlink_to("circle")
    header = json.dumps(json.loads(gltf_text()) | HEADERS[name])
    with pytest.raises(InputError) as caught:
        read(write(tmp_path, f"a.{kind}", header if kind == "gltf" else glb(header)))
    assert caught.value.file and caught.value.cure


def test_a_mesh_that_another_user_may_not_read(open_folder, as_other_user):
    for name, content in GOOD.items():
        write(open_folder, name, content).chmod(0o600)
        with as_other_user(), pytest.raises(InputError, match="Permission denied"):
            read(open_folder / name)


def test_a_path_that_no_file_system_can_follow_is_no_mesh(tmp_path):
    (tmp_path / "circle.obj").symlink_to("circle.obj")
    for name in ("circle.obj", "a\0b.obj", "a" * 300 + ".obj", "x/" * 3000 + "a.ply"):
        with pytest.raises(InputError):
            read(tmp_path / name)


# ---- scale ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scale", [1e-9, 1e9])
def test_any_honest_unit_is_read(tmp_path, scale):
    text = OBJ
    for vertex in VERTICES:
        text = text.replace("v {} {} {}\n".format(*vertex), "v {!r} {!r} {!r}\n".format(*(vertex * scale).tolist()))
    mesh = read(write(tmp_path, "a.obj", text))
    assert mesh.radius == pytest.approx(scale * 0.75**0.5) and len(mesh.faces) == len(FACES)


def test_a_far_vertex_that_no_face_uses_does_not_blur_the_rest(tmp_path):
    assert len(read(write(tmp_path, "a.obj", OBJ + "v 1e9 0 0\n")).faces) == 4


def test_many_and_long_names_of_parts_stay_cheap(tmp_path):
    """A name of a megabyte, a thousand names at once, a million continued lines."""
    cases = {
        "long.obj": OBJ.replace("shell", "x" * 1_000_000),
        "many.obj": OBJ.replace("shell", " ".join(f"part{k}" for k in range(1000))),
        "continued.obj": OBJ + "g a\\\n" + "b\\\n" * 100_000,
        "parts.obj": OBJ + "".join(f"g part{k}\nf 1 2 3\n" for k in range(5_000)),
    }
    for name, text in cases.items():
        path = write(tmp_path, name, text)
        started = time.process_time()
        with pytest.raises(InputError) as caught:
            read_mesh(path, MATERIALS, {"no such": "red"})
        assert len(str(caught.value)) < 5000 and time.process_time() - started < 2
        with pytest.raises(InputError) as caught:
            read_mesh(path, MATERIALS, {"chair": "rot"})
        assert len(str(caught.value)) < 5000


def test_text_whose_words_would_fill_memory_is_refused(tmp_path):
    """Polygons of a million corners, continued lines, and headers of millions of values take many times their size."""
    for name, text in {
        "face.obj": OBJ + "f" + " 1" * 1_500_000,
        "continued.obj": OBJ + "g a\\\n" * 800_000,
        "polygon.off": OFF.replace("3 0 2 1", "1500000" + " 1" * 1_500_000),
        "vertex.stl": STL_TEXT.replace("vertex 1.0", "vertex" + " 1" * 1_500_000),
        "nodes.gltf": gltf_text(nodes=[]).replace('"nodes": []', '"nodes": [{}' + ",{}" * 2_000_001 + "]", 1),
    }.items():
        with pytest.raises(InputError, match="more than 2,000,000|has not three"):
            read(write(tmp_path, name, text))


def test_more_parts_than_any_mesh_has_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("factorlib.meshes.parts.MOST_PARTS", 1000)
    text = "v 0 0 0\nv 1 0 0\nv 0 1 0\n" + "".join(f"g {k}\nf 1 2 3\n" for k in range(1001))
    with pytest.raises(InputError, match="1,001 parts"):
        read(write(tmp_path, "a.obj", text))
