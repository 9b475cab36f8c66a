"""Whatever is in a file, its reader refuses it with file, place and cure, soon and in little memory; what is odd but legal is read."""

from __future__ import annotations

import json
import os
import struct
import time
import tracemalloc
import warnings
import zlib

import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import yaml

from factorlib.errors import InputError
from factorlib.images.exr import write_exr, write_rgb_exr
from factorlib.light.lobes import Lobes
from factorlib.results.lobes import write_lobes
from factorlib.urm.observations import write_observations
from tests.faults.good import (
    CAM_K,
    CAMERAS_TXT,
    DATA,
    DATASET,
    GT,
    IMAGES_TXT,
    LENS,
    MASK,
    MATRIX,
    MESHES,
    OBJ,
    OFF,
    PHOTO,
    PLY,
    PLY_HEADER,
    PLY_TEXT,
    POSE,
    READERS,
    STL,
    STL_TEXT,
    TRUTH,
    H,
    W,
    cameras_bin,
    changed,
    chunk,
    coco,
    edited,
    glb,
    gltf_header,
    gltf_text,
    images_bin,
    make_set,
    observations,
    png,
    png_header,
)

MOST_MEMORY = 60_000_000  # bytes: what a file of some kB may take
MOST_SECONDS = 10.0  # of processor time
HUGE, LONG = 10**12, "9" * 5000
NAN, SIGNALLING = struct.pack("<f", float("nan")), b"\x01\x00\xa0\x7f"
ONE = struct.pack("<f", 1)
DEEP = "[" * 100_000
JSONS = (DEEP, '{"a":' * 500 + "1" + "}" * 500, "", "\x00", "[]", "null")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = make_set(tmp_path_factory.mktemp("hostile") / "set")
    (folder / "m/circle").symlink_to("circle")
    (folder / "m/out").symlink_to("/etc/passwd")
    os.mkfifo(folder / "m/pipe")
    with open(folder / "m/sparse", "wb") as stream:
        stream.truncate(1 << 40)
    return folder


def header_of(**changes) -> bytes:
    return glb(gltf_header() | changes)


def of_buffer(uri: object) -> str:
    return json.dumps(gltf_header() | {"buffers": [{"byteLength": len(DATA), "uri": uri}]})


def long_png(width: int, height: int, kind: int = 0) -> bytes:
    """A PNG whose header promises much, long enough to be believed; whoever looks at its pixels finds none."""
    return png(png_header(width, height, kind=kind), b"").ljust(20_000_000, b"\0")


def accessor(**changes) -> dict:
    return {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3"} | changes


def rewritten(**columns):
    """Observations some of whose columns are others, or gone where they are None."""

    def write(path):
        write_observations(path, observations())
        table = pq.read_table(path)
        for name, column in columns.items():
            if column is None:
                table = table.drop_columns(name)
            else:
                table = table.set_column(table.column_names.index(name), name, column)
        pq.write_table(table, path)

    return write


def with_values(**values):
    return lambda path: write_observations(path, msgspec.structs.replace(observations(), **values))


def many_rows(path):
    """A kilobyte that stands for gigabytes: 200 million rows of one number."""
    zero = pa.array(np.zeros(10_000_000))
    schema = pa.schema({"illumination": pa.float64()}, metadata={"factorlib": "{}"})
    with pq.ParquetWriter(path, schema, compression="zstd") as writer:
        for _ in range(20):
            writer.write_table(pa.table({"illumination": zero}, schema=schema))


def nameless_lobes(path):
    write_lobes(path, {"hall": Lobes(np.eye(3), np.ones(3), np.ones((3, 3)))})
    metadata = {"factorlib": json.dumps({"illuminations": ["other"]})}
    pq.write_table(pq.read_table(path).replace_schema_metadata(metadata), path)


def light_of(value):
    light = np.ones((4, 8, 3), np.float32)
    light[1, 2, 0] = value
    return lambda path: write_rgb_exr(path, light)


def channels(size=(H, W), **values):
    return lambda path: write_exr(path, {name: np.full(size, v, np.float32) for name, v in values.items()})


def widened(width: int, height: int, **values):
    """An EXR whose header promises another size, long enough to be believed."""

    def write(path):
        write_exr(
            path, {name: np.full((H, W), v, np.float32) for name, v in (values or dict.fromkeys("RGB", 1)).items()}
        )
        content = path.read_bytes()
        for name in (b"dataWindow\0box2i\0", b"displayWindow\0box2i\0"):
            at = content.index(name) + len(name) + 4
            content = content[:at] + struct.pack("<4i", 0, 0, width - 1, height - 1) + content[at + 16 :]
        path.write_bytes(content.ljust(50_000_000, b"\0"))

    return write


def dataset(*place, value) -> str:
    return yaml.safe_dump(edited(DATASET, *place, value=value))


def transforms(matrix=MATRIX, **lens) -> dict:
    return {**LENS, **lens, "frames": [{"file_path": "7.png", "transform_matrix": matrix}]}


def frame_of(angle: float, **size) -> dict:
    return {**size, "camera_angle_x": angle, "frames": [{"file_path": "7.png", "transform_matrix": MATRIX}]}


TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
LAUGHS = "a: &a [x,x,x,x,x,x,x,x,x,x]\n"
LAUGHS += "".join(f"{b}: &{b} [{','.join([f'*{a}'] * 10)}]\n" for a, b in zip("abcdefghi", "bcdefghij"))
TEXT = b"a\x00\x00" + zlib.compress(b"\x00" * 200_000_000)  # 200 kB
ZIGZAG = [coordinate for k in range(100_000) for coordinate in ((0, 0) if k % 2 else (W, H))]

# reader -> (file, what is in it, what is said of it)
REFUSED = {
    "mesh": [
        ("a.obj", OBJ.replace("v 1.0", "v 1e300"), r"1e\+300"),
        ("a.obj", OBJ.replace("v 1.0", "v 1e999"), "not finite"),
        ("a.obj", OBJ.replace("v 1.0", "v nan"), "not finite"),
        ("a.obj", OBJ.replace("v 1.0", "v one"), "line 6"),
        ("a.obj", OBJ.replace("f 1 ", f"f {LONG} "), "line 10"),
        ("a.obj", OBJ.replace("//1", f"//{LONG}"), "line 10"),
        ("a.obj", OBJ.replace("vn 0 0 1", "vn 1"), "line 9"),
        ("a.obj", TRIANGLE + "f 1 2 4\n", "uses vertex 4 of 3"),
        ("a.obj", TRIANGLE + "f 1 2 0\n", "line 4"),
        ("a.obj", "", "without faces"),
        ("a.obj", b"\0" * 100, "without faces|cannot be read"),
        ("a.obj", TRIANGLE.replace("0 1 0", "2 0 0") + "f 1 2 3\n", "zero area"),
        ("a.obj", OBJ.replace("1.0", "1e-300"), "1e-300"),
        ("a.obj", OBJ + "f" + " 1" * 1_500_000, "more than 2,000,000|has not three"),
        ("a.obj", OBJ + "g a\\\n" * 800_000, "more than 2,000,000"),
        ("a.xyz", OBJ, "unknown mesh format"),
        ("gone.obj", os.unlink, "No such file"),
        ("a.off", OFF.replace("1.0", "nan"), "not finite"),
        ("a.off", OFF.replace("3 0 2 1", f"3 0 2 {'9' * 30}"), "."),
        ("a.off", OFF.replace("4 4 0", "-4 4 0"), "."),
        ("a.off", OFF.replace("4 4 0", f"{HUGE} 4 0"), "."),
        ("a.off", OFF.replace("4 4 0", f"4 {HUGE} 0"), "."),
        ("a.off", OFF.replace("3 0 2 1", f"{HUGE} 0 2 1"), "."),
        ("a.off", "OFF BINARY\n" + OFF[4:], "."),
        ("a.off", "OFF", "."),
        ("a.stl", STL_TEXT.replace("1.0", "nan"), "not finite"),
        ("a.stl", STL_TEXT.replace("vertex 1.0 0.0 0.0\n", "", 1), "."),
        ("b.stl", STL.replace(ONE, SIGNALLING), "not finite"),
        ("b.stl", STL[:-1], "."),
        ("b.stl", STL[:80] + b"\xff" * 4 + STL[84:], "."),
        ("b.stl", STL[:80] + bytes(4), "without faces"),
        ("b.ply", PLY.replace(ONE, NAN), "not finite"),
        ("b.ply", PLY[:-1], "."),
        ("b.ply", PLY.replace(b"face 4", b"face %d" % HUGE), "."),
        ("b.ply", PLY.replace(b"uchar int", b"uint int")[:-52] + b"\xff\xff\xff\xff" * 13, "."),
        ("a.ply", PLY_TEXT.replace("vertex 4", f"vertex {HUGE}"), "."),
        ("a.ply", PLY_TEXT.replace("vertex 4", "vertex -4"), "."),
        ("a.ply", PLY_TEXT[:-9], "."),
        ("a.ply", PLY_TEXT.replace("3 0 2 1", "3 0 two 1"), "."),
        ("a.ply", PLY_TEXT.replace("float x", f"{LONG} x"), "."),
        ("a.ply", PLY_TEXT.replace("float x", "float w"), "."),
        ("a.ply", PLY_TEXT.replace("float y", "float x"), "."),
        ("a.ply", PLY_TEXT.replace("3 0 2 1", f"3 0 2 {'9' * 30}"), "."),
        ("a.ply", PLY_HEADER.format("ascii").replace("end_header\n", ""), "."),
        ("a.gltf", '{"extras": ' + DEEP, "."),
        ("a.gltf", gltf_text().replace("shell", "stühle").encode("latin-1"), "."),
        ("a.gltf", gltf_text(extensionsRequired=["KHR_draco_mesh_compression"]), "compress"),
        (
            "a.gltf",
            gltf_text(nodes=[]).replace('"nodes": []', '"nodes": [{}' + ",{}" * 2_000_001 + "]", 1),
            "more than",
        ),
        *(("a.gltf", text, ".") for text in JSONS),
        *(("a.gltf", of_buffer(uri), ".") for uri in ("data:;base64,!!!", "http://x/y.bin", "a%00b", "m/circle")),
        ("a.gltf", of_buffer("m/pipe"), "is a pipe"),
        ("a.glb", glb()[:-1], "."),
        ("a.glb", glb()[:12] + b"\xff\xff\xff\x7f" + glb()[16:], "."),
        ("a.glb", struct.pack("<4sII", b"glTF", 1, 20) + b"\0" * 8, "."),
        ("a.glb", glb(data=DATA.replace(ONE, SIGNALLING)), "not finite"),
        ("a.glb", glb(DEEP), "."),
        ("a.glb", header_of(accessors=[accessor(count=HUGE)] * 2), "."),
        ("a.glb", header_of(accessors=[accessor(), {"componentType": 5125, "count": HUGE, "type": "SCALAR"}]), "."),
        ("a.glb", header_of(accessors=[accessor(count=-1)] * 2), "."),
        ("a.glb", header_of(accessors=[accessor(componentType=7)] * 2), "."),
        ("a.glb", header_of(accessors=[accessor(bufferView=9)] * 2), "."),
        ("a.glb", header_of(accessors=[]), "."),
        ("a.glb", header_of(buffers=[{"byteLength": HUGE}]), "."),
        ("a.glb", header_of(buffers=None), "."),
        ("a.glb", header_of(bufferViews=[{"buffer": 7, "byteLength": 48}] * 2), "."),
        ("a.glb", header_of(bufferViews=[{"buffer": 0, "byteOffset": HUGE, "byteLength": 48}] * 2), "."),
        ("a.glb", header_of(nodes=[{"children": [1] * 40}] * 2), "."),
        ("a.glb", header_of(nodes=[{"children": [k + 1, k + 1]} for k in range(60)] + [{"mesh": 0}]), "."),
        ("a.glb", header_of(nodes=[{"children": [0], "mesh": 0}]), "."),
        ("a.glb", header_of(nodes=[{"mesh": 0, "scale": [1e300] * 3}]), "."),
        ("a.glb", header_of(nodes=[{"mesh": 0, "rotation": [0, 0, 0, 0]}]), "."),
        ("a.glb", header_of(nodes=[{"mesh": 7}]), "."),
        ("a.glb", header_of(scene=7), "."),
        ("a.glb", header_of(meshes=[{"primitives": [{"attributes": {"POSITION": 0}, "mode": 0}]}]), "."),
        ("a.glb", header_of(asset={"version": "1.0"}), "."),
    ],
    "set": [  # what meshes draw in must lie in the data set's folder, and be there
        *(
            (file, text(uri), words)
            for uri, words in [
                ("circle", "no path that can be followed"),
                ("circle/a.bin", "no path that can be followed"),
                ("a\0b", "no path that can be followed"),
                ("ü" * 200, "no path that can be followed"),
                ("c/" * 3000, "no path that can be followed"),
                ("../../a.bin", "outside the dataset"),
                ("out", "outside the dataset"),
            ]
            for file, text in (("m/chair.obj", lambda uri: OBJ.replace("a.mtl", uri)), ("m/box.gltf", of_buffer))
        ),
        *(("m/box.gltf", of_buffer(uri), ".") for uri in (5, "https://x/y.bin", ".", "pipe", "gone.bin", "sparse")),
        *(("m/box.gltf", text, ".") for text in JSONS if text not in ("[]", "null")),
        ("dataset.yaml", DEEP, "nested more than 64 deep"),
        ("dataset.yaml", "- " * 2000 + "a", "nested more than 64 deep"),
        ("dataset.yaml", "{a: " * 500 + "1" + "}" * 500, "nested more than 64 deep"),
        ("dataset.yaml", "format: " + "1" * 5000, "a number of 5000 characters"),
        ("dataset.yaml", "format: !!int one", "'one' is no int"),
        ("dataset.yaml", "format: !!python/tuple [1]", "the tag 'tag:yaml.org,2002:python/tuple' is not known"),
        ("dataset.yaml", "format: *none", "no &none above"),
        ("dataset.yaml", "format: 1\n---\nformat: 2\n", "a second document"),
        ("dataset.yaml", "format: \x07", "not YAML"),
        ("dataset.yaml", "\x00\x00\x00", "not YAML"),
        ("dataset.yaml", yaml.safe_dump(DATASET) + "results: {red: 1}\n", "results"),
        *(("dataset.yaml", dataset(key, value=1), ".") for key in ("x` - at `$.b[3]", "a\n\nb", "x" * 100_000)),
        ("truth.yaml", edited(TRUTH, "materials", "red", "roughness", value=-7), "0 to 1|roughness"),
        ("truth.yaml", edited(TRUTH, "materials", "red", "specular", value=[1.5, 0.1, 0.1]), "specular"),
        ("truth.yaml", edited(TRUTH, "materials", "red", "diffuse", value=[0.5, -0.1, 0.1]), "diffuse"),
        ("truth.yaml", edited(TRUTH, "poses", "hall", "vase", "translation", value=[0, 0, 1e300]), "translation"),
        ("truth.yaml", edited(TRUTH, "poses", "hall", "vase", "rotation", value=[[2, 0, 0]] * 3), "rotation"),
    ],
    "mask": [
        *(
            ("mask.png", content, "not readable as a PNG")
            for content in (b"", b"GIF89a", MASK[:40], MASK[:16] + bytes(99))
        ),
        ("mask.png", MASK[:33] + chunk(b"zTXt", TEXT) + MASK[33:], "not readable as a PNG"),
        ("mask.png", long_png(30_000, 30_000), "the mask is 30000 × 30000 pixels, the photo 16 × 12"),
        (
            "mask.png",
            png(png_header(W, H, kind=2), zlib.compress(b"".join(b"\0" + bytes(range(48)) for _ in range(H)))),
            "colour",
        ),
        ("mask.png", png(png_header(W, H), zlib.compress(bytes([0, *[7] * W]) * H)), "unknown label 7"),
        ("mask.png", png(png_header(W, H), zlib.compress(bytes(W + 1) * H)), "the mask is empty"),
        *(
            ("coco.json", coco({"size": [H, W], "counts": counts}), ".")
            for counts in (
                [10**30],
                [-5, 5, H * W],
                [],
                "o" * 2_000_000,
                "_" * 2_000_000 + "0",
                "P" * 50 + "0",
                "~",
                "é",
                5,
            )
        ),
        ("coco.json", coco({"size": [10**9, 10**9], "counts": [10**18]}), "."),
        ("coco.json", coco({"size": [-1, -1], "counts": [1]}), "."),
        *(
            ("coco.json", coco(shape), ".")
            for shape in ("x", 5, [], [[]], [[1, 2, 3]], [["a"] * 6], [[0, 0, 1e300, 0, 0, 1]])
        ),
        ("coco.json", coco([ZIGZAG]), "pixels long"),
        ("coco.json", coco(*[[[0, 0, W, 0, W, H, 0, H]] * 400] * 400), "longer than any drawing"),
        *(
            ("coco.json", coco([[2, 2, 8, 2, 8, 8]], image=i), ".")
            for i in ({"file_name": 5}, {"id": None}, {"width": 10**15})
        ),
        *(("coco.json", text, "not readable as COCO|.") for text in (*JSONS, '{"images": 5}')),
    ],
    "masks": [
        ("7.png", long_png(30_000, 30_000, kind=2), "900 megapixels; at most 200"),
        ("7.png", PHOTO[:-30], "truncated or damaged"),
        ("a.exr", widened(60_000, 30_000), "megapixels|million values"),
    ],
    "photo": [
        ("8.png", b"no photo", "8.png"),
        ("8.png", long_png(30_000, 30_000, kind=2), "megapixels"),
        (
            "mask.png",
            png(png_header(W, H + 1), zlib.compress(bytes(W + 1) * (H + 1))),
            "the mask is 16 × 13 pixels, the photo 16 × 12",
        ),
    ],
    "objects": [
        ("m/chair.obj", OBJ.replace("g shell", "g shell2"), "has no material|no part 'shell'"),
        ("m/chair.obj", OBJ.replace("v 1.0", "v nan"), "not finite"),
        ("buffers/b 1.bin", DATA[:30], "has 30 of 72 bytes"),
    ],
    "true maps": [
        *((name, widened(60_000, 30_000), "million values") for name in ("light.exr", "normals.exr")),
        ("light.exr", widened(2000, 1500, R=1, G=1, B=1, **{f"C{k:03}": 0 for k in range(900)}), "million values"),
    ],
    "colmap": [
        *(
            ("model/cameras.bin", cameras_bin(cameras=n), "not readable as a COLMAP model")
            for n in (2, 2**40, 2**64 - 1)
        ),
        *(("model/images.bin", images_bin(images=n), "not readable as a COLMAP model") for n in (2, 2**40, 2**64 - 1)),
        ("model/images.bin", images_bin(points=2**63), "not readable as a COLMAP model"),
        ("model/cameras.bin", cameras_bin(model=77), "77 is no camera model"),
        ("model/cameras.bin", cameras_bin(width=0), "is no camera"),
        ("model/cameras.bin", cameras_bin(params=(float("nan"), 104.0, 71.0)), "is no camera"),
        ("model/cameras.bin", cameras_bin(params=(1e-300, 104.0, 71.0)), "no photo's"),
        ("model/cameras.bin", cameras_bin(params=(300.0, 1e9, 71.0)), "no photo's"),
        ("model/cameras.bin", cameras_bin(params=(300.0,)), "not readable as a COLMAP model"),
        ("model/images.bin", images_bin(numbers=(0.0,) * 7), "is no pose"),
        ("model/images.bin", images_bin(numbers=(*POSE[:6], float("inf"))), "is no pose"),
        ("model/images.bin", images_bin(camera_id=9), "has camera 9"),
    ],
    "colmap text": [
        *(("text/cameras.txt", CAMERAS_TXT.replace(b" 300 ", b" "), "."), ("text/cameras.txt", b"1", ".")),
        ("text/cameras.txt", CAMERAS_TXT.replace(b"SIMPLE_PINHOLE", b"NONE"), "."),
        ("text/cameras.txt", CAMERAS_TXT.replace(b"200", LONG.encode()), "."),
        ("text/images.txt", IMAGES_TXT.replace(b".7 ", b"nan "), "."),
        ("text/images.txt", IMAGES_TXT.replace(b".7 ", b"one "), "."),
        ("text/images.txt", b"\xff\xfe\x00", "."),
    ],
    "transforms": [
        *(("t.json", text, ".") for text in (*JSONS, '{"frames": null}', '{"w": ' + LONG + "}", '{"frames": [[]]}')),
        *(
            ("t.json", transforms(matrix), ".")
            for matrix in ([[1e300, 0, 0, 0]] * 3, [[0] * 4] * 3, [], [[1, 0, 0]] * 3)
        ),
        *(("t.json", frame_of(angle, w=200, h=150), r"frames\[0\]") for angle in (0.0, -1.0, 1e-300, 4.0)),
        *(("t.json", transforms(w=w), r"\bw\b") for w in (1e30, 1e12, -200, 0.4)),
        *(("t.json", transforms(fl_x=f), "fl_x") for f in (1e300, 1e-300, -3)),
        ("t.json", transforms(cx=1e9), "cx"),
        ("t.json", transforms(k1=1e14), "image_undistorter"),
        ("t.json", transforms(camera_model="X" * 10_000), "camera_model"),
    ],
    "bop": [
        *(
            ("model/scene_camera.json", {name: {"cam_K": CAM_K}}, "not the id of an image")
            for name in ("²", "", "-1", LONG)
        ),
        ("model/scene_camera.json", {"7": {"cam_K": [1e300, 0, 103.5, 0, 1e300, 70.5, 0, 0, 1.0]}}, "cam_K"),
        ("model/scene_camera.json", {"7": {"cam_K": [300, 0, 1e9, 0, 300, 70.5, 0, 0, 1.0]}}, "cam_K"),
        ("model/scene_camera.json", [], "."),
        ("model/scene_gt.json", {"7": [GT | {"cam_t_m2c": [0, 0, 1e300]}]}, "cam_t_m2c"),
        ("model/scene_gt.json", {"7": [GT | {"obj_id": "5"}]}, "obj_id"),
        ("model/scene_gt.json", {"7": GT}, "."),
    ],
    "true light": [("light.exr", light_of(value), "hall") for value in (np.nan, np.inf, -7.0, -0.1)],
    "true normals": [
        ("n.exr", channels(R=0, G=0), "has no channel B"),
        ("n.exr", channels(**{"normal.x": 0, "normal.y": 0}), "has no channel normal.z"),
        ("n.exr", channels((6, 8), R=0, G=0, B=1), "the normals have 8 × 6 pixels, the photo 16 × 12"),
        ("n.exr", channels(R=0, G=0, B=np.inf), "infinite"),
    ],
    "observations": [
        ("a.parquet", with_values(material=np.full(5, 1)), "'material' points beyond the names"),
        ("a.parquet", with_values(photo=np.full(5, -1)), "'photo' points beyond the names"),
        ("a.parquet", with_values(exposures=(1.0, 2.0)), "exposures"),
        ("a.parquet", rewritten(weight=None), "0 columns 'weight'"),
        ("a.parquet", rewritten(weight=pa.array([1.0, None, 1.0, 1.0, 1.0])), "'weight' has empty places"),
        ("a.parquet", rewritten(weight=pa.array(["a"] * 5)), "of type string"),
        ("a.parquet", rewritten(x=pa.array([HUGE] * 5)), "not readable"),
        (
            "a.parquet",
            rewritten(normal=pa.FixedSizeListArray.from_arrays(pa.array(np.zeros(10)), 2)),
            "'normal' is of type",
        ),
        (
            "a.parquet",
            rewritten(visibility=pa.array([b"x" * 10_000] * 5, pa.binary(10_000))),
            "'visibility' is of type",
        ),
    ],
    "lobes": [
        ("a.parquet", many_rows, "200,000,000 rows, more than 100,000,000"),
        ("a.parquet", nameless_lobes, "an illumination that its metadata do not name"),
    ],
    "yaml": [("a.yaml", text, "more than 2,000 values") for text in (LAUGHS, "[" + "a," * 100_000 + "]")],
    "json": [("a.json", text, "not readable as JSON") for text in (DEEP, LONG, "", "\x00", "{'a': 1}")],
    "poses": [
        ("poses.json", text, "poses.json") for text in ("[]", '{"a": {"camera": {"focal_px": -1}, "objects": {}}}')
    ],
}
CASES = [(reader, *case) for reader, cases in REFUSED.items() for case in cases]


def work(folder, reader, name):
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # a warning that names our source is no word to a user
        READERS[reader](folder, name)


@pytest.mark.parametrize("reader, name, content, words", CASES, ids=[f"{r}-{n}" for r, n, *_ in CASES])
def test_it_is_refused_by_name_soon_and_in_little_memory(folder, reader, name, content, words):
    if content is os.unlink:
        content = lambda path: None  # noqa: E731
    with changed(folder, name, content) as path:
        size = path.stat().st_size if path.exists() else 0
        began = time.process_time()
        tracemalloc.start()
        try:
            with pytest.raises(InputError, match=words) as caught:
                work(folder, reader, name)
            assert tracemalloc.get_traced_memory()[1] < MOST_MEMORY + 40 * size
        finally:
            tracemalloc.stop()
    assert time.process_time() - began < MOST_SECONDS
    error = caught.value
    assert error.file and error.cure and "\n" not in error.found and len(str(error)) < 1500


SPECIAL = [
    ("set", "dataset.yaml"),
    ("set", "truth.yaml"),
    ("set", "m/box.gltf"),
    ("mask", "mask.png"),
    ("mask", "coco.json"),
]
SPECIAL += [("colmap", "model/cameras.bin"), ("colmap", "model/images.bin"), ("colmap text", "text/images.txt")]
SPECIAL += [("transforms", "t.json"), ("bop", "model/scene_camera.json"), ("bop", "model/scene_gt.json")]
SPECIAL += [("observations", "observations.parquet"), ("lobes", "solve/lobes.parquet"), ("poses", "poses.json")]
SPECIAL += [("photo", "7.png"), ("objects", "m/chair.obj"), *(("mesh", name) for name in MESHES)]
KINDS = {
    "pipe": lambda path: (path.unlink(), os.mkfifo(path)),
    "device": lambda path: (path.unlink(), path.symlink_to("/dev/zero")),
    "folder": lambda path: (path.unlink(), path.mkdir()),
    "link in a circle": lambda path: (path.unlink(), path.symlink_to(path.name)),
    "terabyte": lambda path: os.truncate(path, 1 << 40),
}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("reader, name", SPECIAL)
def test_what_is_no_plain_file_of_a_sane_size_is_never_opened(folder, reader, name, kind):
    """Whoever opened it would wait for ever, or fill the memory."""
    if kind == "terabyte" and reader not in ("set", "mask", "mesh", "objects"):
        pytest.skip("no limit on the size of this file is promised")
    with changed(folder, name, KINDS[kind]), pytest.raises(InputError) as caught:
        work(folder, reader, name)
    assert caught.value.file and caught.value.cure


@pytest.mark.parametrize(
    "reader, name", [case for case in SPECIAL if case[0] not in ("colmap", "colmap text", "transforms", "bop")]
)
def test_what_another_user_may_not_read_says_so(open_folder, as_other_user, reader, name):
    folder = make_set(open_folder / "set")
    READERS[reader](folder, name)  # loads what another user may not: Python may lie in root's home
    (folder / name).chmod(0)
    with as_other_user(), pytest.raises(InputError, match="Permission denied"):
        work(folder, reader, name)


# ── odd, and legal ───────────────────────────────────────────────────────────────────────────────────────────────────

SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 0.5, 1]])
SIDES = [[3, 2, 1, 0], [0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]]
PYRAMID = "".join("{} {} {}\n".format(*v) for v in SQUARE) + "".join(
    f"{len(f)} {' '.join(map(str, f))}\n" for f in SIDES
)
PYRAMID_HEADER = PLY_HEADER.replace("vertex 4", "vertex 5").replace("face 4", "face 5")
PYRAMID_BIG = (
    PYRAMID_HEADER.format("binary_big_endian").encode()
    + SQUARE.astype(">f4").tobytes()
    + b"".join(struct.pack(f">B{len(f)}i", len(f), *f) for f in SIDES)
)
TEXTURED = {
    "images": [{"uri": "m/pipe"}, {"uri": "/dev/zero"}],
    "textures": [{"source": 0}],
    "materials": [{"name": "red", "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
}
DOTS = [{"size": [H, W], "counts": [k, 1, H * W - k - 1]} for k in range(0, H * W, 2)] * 100
OTHERS_SHAPE = {"image_id": 8, "category_id": 1, "segmentation": {"size": [1, 1], "counts": "o" * 1000}}
READ = [
    *(("mesh", name, content) for name, content in MESHES.items()),
    ("mesh", "a.obj", OBJ.replace("red", "stühle").encode("latin-1")),
    ("mesh", "a.off", OFF.replace("OFF\n", "OFF\n# Möbel\n").encode("latin-1")),
    ("mesh", "a.stl", STL_TEXT.replace("chair", "Stühle").encode("latin-1")),
    ("mesh", "a.ply", PLY_TEXT.replace("TextureFile a", "Möbel").encode("latin-1")),
    ("mesh", "a.ply", PYRAMID_HEADER.format("ascii") + PYRAMID),
    ("mesh", "a.ply", PYRAMID_BIG),
    ("mesh", "a.off", f"OFF 5 5 0\n{PYRAMID}"),
    ("mesh", "a.obj", OBJ.replace("vn 0 0 1", "vn nan inf 1e300")),
    ("mesh", "a.obj", OBJ + "v 1e9 0 0\n"),  # which no face uses
    ("mesh", "a.obj", OBJ.replace("a.mtl", "m/pipe")),
    ("mesh", "a.gltf", gltf_text(**TEXTURED)),
    ("mesh", "a.gltf", of_buffer("buffers/b%201.bin")),
    ("mesh", "a.glb", glb(gltf_header("m/../buffers/b%201.bin") | TEXTURED, b"")),
    ("set", "m/a.mtl", "newmtl red\nmap_Kd m/pipe\nmap_Ks |touch pwned\nmap_Ns ../../../etc/passwd\n"),
    ("set", "m/box.gltf", gltf_text(**TEXTURED)),
    ("mask", "coco.json", coco(*DOTS, [[2, 2, 8, 2, 8, 8]])),
    ("mask", "coco.json", {**json.loads(coco([[2, 2, 8, 2, 8, 8]])), "more": OTHERS_SHAPE}),
    ("transforms", "t.json", transforms(stamp=1.7e18, note=[[[]]])),
    ("true light", "light.exr", light_of(-1e-4)),  # what resampling leaves
    ("true normals", "n.exr", channels(**{f"normal.{axis}": np.nan for axis in "xyz"})),
]


@pytest.mark.parametrize("reader, name, content", READ)
def test_what_is_odd_and_legal_is_read_and_opens_no_texture(folder, reader, name, content):
    with changed(folder, name, content):
        began = time.process_time()
        work(folder, reader, name)
        assert time.process_time() - began < MOST_SECONDS


def test_the_good_files_are_good(folder):
    for reader, name in SPECIAL + [("masks", "7.png"), ("true maps", ""), ("solution", ""), ("json", "coco.json")]:
        work(folder, reader, name)
