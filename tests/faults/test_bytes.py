"""Bytes × readers: whatever a file holds, it is read, or refused with file, place and cure, soon and in little memory.

Tables hold what was found before, among it what means harm: the promises of docs/security.md. Beyond them files of every kind are
spoiled at random: `make test` spoils some hundred, always the same; the long test goes on for FUZZ_SECONDS (600), shared by its
parts, each time with others. A last table has the writers, which find no room.
"""

import contextlib
import copy
import errno
import json
import logging
import os
import re
import resource
import struct
import tempfile
import time
import tracemalloc
import warnings
import zlib
from pathlib import Path

import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
import yaml
from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st

from factorlib.checkpoint import Checkpoint
from factorlib.dataset.read_dataset import read_dataset
from factorlib.errors import InputError
from factorlib.images.exr import encode_pixels, write_exr, write_rgb_exr
from factorlib.images.picture import write_png
from factorlib.jsonfile import write_json
from factorlib.light.lobes import Lobes
from factorlib.meshes.read_mesh import read_mesh
from factorlib.recipe.read_recipe import read_recipe
from factorlib.reflection.network import Layers, write_layers
from factorlib.results.lobe_table import write_lobes
from factorlib.runner import verbs
from factorlib.runner.dataset_state import Request, read_state
from factorlib.runner.project import LIBRARY, Project, photo_sets
from factorlib.urm.observations import write_observations
from factorlib.wholefile import bytes_of, disk_error, replace_file, write_bytes
from tests.faults import sample
from tests.faults.sample import (
    DATA,
    DATASET,
    MESHES,
    OBJ,
    OFF,
    PICTURES,
    PLAIN,
    PLY,
    PLY_TEXT,
    READERS,
    SOURCES,
    STL,
    STL_TEXT,
    TRUTH,
    H,
    W,
    coco,
    edited,
    glb,
    make_set,
    png,
    png_header,
    put,
)
from tests.refusal import refusal
from tests.report.test_page import page_of, run
from tests.runner.toy import call, real_project

PATHS = {  # every path that dataset.yaml and truth.yaml may hold, and the suffix it has
    ("photos", 0, "image"): ".png", ("photos", 1, "masks"): ".png", ("photos", 0, "masks", "red"): ".png",
    ("photos", 0, "objects", 0, "mask"): ".png", ("meshes", "vase", "file"): ".ply", ("truth",): ".yaml",
    ("cameras", "colmap"): "", ("cameras", "transforms"): ".json", ("cameras", "bop"): "",
    ("illumination", "hall"): ".exr", ("normals", "room"): ".exr",
    ("albedo", "room"): ".exr",
}  # fmt: skip
MOST_SECONDS = 10.0  # of processor time
HUGE, LONG = 10**12, "9" * 5000
NAN, SIGNALLING, ONE = struct.pack("<f", float("nan")), b"\x01\x00\xa0\x7f", struct.pack("<f", 1)
DEEP = "[" * 100_000
JSONS = (DEEP, '{"a":' * 500 + "1" + "}" * 500, "", "\x00", "[]", "null")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The good data set with links that lead out, in a circle, or to what never ends, and beside it a secret."""
    folder = make_set(tmp_path_factory.mktemp("hostile") / "set")
    links = {
        "circle": "circle",
        "m/circle": "circle",
        "link.png": "/etc/passwd",
        "m/out": "/etc/passwd",
        "up": folder.parent,
    }
    for suffix in filter(None, {*PATHS.values()}):
        put(folder.parent / f"secret{suffix}", "secret")
        links |= {
            f"link{suffix}": f"../secret{suffix}",
            f"m/link{suffix}": f"../../secret{suffix}",
            f"twice{suffix}": f"link{suffix}",
        }
        os.mkfifo(folder / f"pipe{suffix}")
    (folder.parent / "secret").mkdir()
    for name, target in ({"link": "../secret", "m/link": "../../secret", "twice": "link"} | links).items():
        (folder / name).symlink_to(target)
    os.mkfifo(folder / "m/pipe")
    put(folder / "m/sparse", b"")
    os.truncate(folder / "m/sparse", 1 << 40)
    return folder


@pytest.fixture(scope="module")
def linked(tmp_path_factory):
    """This project with a build/ of its own."""
    return real_project(tmp_path_factory.mktemp("project"))


# ── contents ─────────────────────────────────────────────────────────────────────────────────────────────────────────


def header_of(**changes) -> bytes:
    return glb(sample.gltf_header() | changes)


def of_buffer(uri: object) -> str:
    return json.dumps(sample.gltf_header() | {"buffers": [{"byteLength": len(DATA), "uri": uri}]})


def rows(row: bytes, width: int = W, height: int = H, kind: int = 0, before: bytes = b"") -> bytes:
    """A PNG all of whose rows are the same."""
    return sample.png(sample.png_header(width, height, kind=kind), zlib.compress((b"\0" + row) * height), before=before)


def long_png(kind: int = 0) -> bytes:
    """A PNG whose header promises much, long enough to be believed; whoever looks at its pixels finds none."""
    return sample.png(sample.png_header(30_000, 30_000, kind=kind), b"").ljust(20_000_000, b"\0")


def rewritten(name, column=None):
    """Observations of which a column is another, or gone."""

    def write(path):
        write_observations(path, sample.observations())
        table = pq.read_table(path)
        at = table.column_names.index(name)
        pq.write_table(table.drop_columns(name) if column is None else table.set_column(at, name, column), path)

    return write


def with_values(**values):
    return lambda path: write_observations(path, msgspec.structs.replace(sample.observations(), **values))


def many_rows(path):
    """A kilobyte that stands for gigabytes: 200 million rows of one number."""
    schema = pa.schema({"illumination": pa.int8()}, metadata={"factorlib": "{}"})
    table = pa.table({"illumination": pa.array(np.zeros(10_000_000, np.int8))}, schema=schema)
    with pq.ParquetWriter(path, schema, compression="zstd") as writer:
        for _ in range(20):
            writer.write_table(table)


def nameless_lobes(path):
    write_lobes(path, {"hall": Lobes(np.eye(3), np.ones(3), np.ones((3, 3)))})
    metadata = {"factorlib": json.dumps({"illuminations": ["other"]})}
    pq.write_table(pq.read_table(path).replace_schema_metadata(metadata), path)


def channels(size=(H, W), **values):
    return lambda path: write_exr(path, {name: np.full(size, v, np.float32) for name, v in values.items()})


def widened(width: int, height: int, **values):
    """An EXR whose header promises another size, long enough to be believed."""

    def write(path):
        channels(**(values or dict.fromkeys("RGB", 1)))(path)
        windows = (struct.pack("<4i", 0, 0, right - 1, down - 1) for right, down in ((W, H), (width, height)))
        path.write_bytes(path.read_bytes().replace(*windows).ljust(50_000_000, b"\0"))

    return write


def transforms(matrix=sample.MATRIX, **lens) -> dict:
    return {**sample.LENS, **lens, "frames": [{"file_path": "7.png", "transform_matrix": matrix}]}


TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
LAUGHS = "a: &a [x,x,x,x,x,x,x,x,x,x]\n" + "".join(
    f"{b}: &{b} [{','.join([f'*{a}'] * 10)}]\n" for a, b in zip("abcdefghi", "bcdefghij")
)
ZIGZAG = [coordinate for k in range(100_000) for coordinate in ((0, 0) if k % 2 else (W, H))]
BAD_RUNS = [[10**30], [-5, 5, H * W], [], "o" * 2_000_000, "_" * 2_000_000 + "0", "P" * 50 + "0", "~", "é", 5]
BAD_SHAPES = [
    "x", 5, [], [[]], [[1, 2, 3]], [["a"] * 6], [[0, 0, 1e300, 0, 0, 1]], {"size": [-1, -1], "counts": [1]},
    {"size": [10**9, 10**9], "counts": [10**18]}, *({"size": [H, W], "counts": runs} for runs in BAD_RUNS),
]  # fmt: skip
NO_PATH, OUTSIDE, NO_MODEL = "not a path that can be followed", "outside the dataset", "not readable as a COLMAP model"
URIS = dict.fromkeys(["circle", "circle/a.bin", "a\0b", "ü" * 200, "c/" * 3000], NO_PATH) | dict.fromkeys(
    ["../../a.bin", "out"], OUTSIDE
)

# (reader, file) -> what is in it, or that and what is said of it
REFUSED = {
    ("mesh", "a.obj"): [
        (OBJ.replace("v 1.0", "v 1e300"), r"1e\+300"), (OBJ.replace("v 1.0", "v 1e999"), "not finite"),
        (OBJ.replace("v 1.0", "v nan"), "not finite"),
        (OBJ.replace("v 1.0", "v one"), "line 6"), (OBJ.replace("f 1 ", f"f {LONG} "), "line 10"),
        (OBJ.replace("//1", f"//{LONG}"), "line 10"),
        (OBJ.replace("vn 0 0 1", "vn 1"), "line 9"), (TRIANGLE + "f 1 2 4\n", "uses vertex 4, but there are 3 vertices"),
        (TRIANGLE + "f 1 2 0\n", "line 4"),
        ("", "has no faces"), (b"\0" * 100, "has no faces|cannot be read"),
        (TRIANGLE.replace("0 1 0", "2 0 0") + "f 1 2 3\n", "zero area"),
        (OBJ.replace("1.0", "1e-300"), "1e-300"), (OBJ + "f" + " 1" * 1_500_000, "more than 2,000,000|has not three"),
        (OBJ + "g a\\\n" * 800_000, "more than 2,000,000"),
    ],
    ("mesh", "a.xyz"): [(OBJ, "unknown mesh format")],
    ("mesh", "gone.obj"): [(lambda path: None, "No such file")],
    ("mesh", "a.off"): [
        (OFF.replace("1.0", "nan"), "not finite"), OFF.replace("3 0 2 1", f"3 0 2 {'9' * 30}"),
        OFF.replace("4 4 0", "-4 4 0"),
        OFF.replace("4 4 0", f"{HUGE} 4 0"), OFF.replace("4 4 0", f"4 {HUGE} 0"),
        OFF.replace("3 0 2 1", f"{HUGE} 0 2 1"), "OFF BINARY\n" + OFF[4:], "OFF",
    ],
    ("mesh", "a.stl"): [(STL_TEXT.replace("1.0", "nan"), "not finite"),
    STL_TEXT.replace("vertex 1.0 0.0 0.0\n", "", 1)],
    ("mesh", "b.stl"): [
        (STL.replace(ONE, SIGNALLING), "not finite"), STL[:-1], STL[:80] + b"\xff" * 4 + STL[84:],
        (STL[:80] + bytes(4), "has no faces"),
    ],
    ("mesh", "b.ply"): [
        (PLY.replace(ONE, NAN), "not finite"), PLY[:-1], PLY.replace(b"face 4", b"face %d" % HUGE),
        PLY.replace(b"uchar int", b"uint int")[:-52] + b"\xff\xff\xff\xff" * 13,
    ],
    ("mesh", "a.ply"): [PLY_TEXT[:-9], sample.PLY_HEADER.format("ascii").replace("end_header\n", ""),
    *(PLY_TEXT.replace(old, new) for old, new in (
        ("vertex 4", f"vertex {HUGE}"), ("vertex 4", "vertex -4"), ("3 0 2 1", "3 0 two 1"),
        ("3 0 2 1", f"3 0 2 {'9' * 30}"),
        ("float x", f"{LONG} x"), ("float x", "float w"), ("float y", "float x"),
    ))],
    ("mesh", "a.gltf"): [
        '{"extras": ' + DEEP, sample.gltf_text().replace("shell", "stühle").encode("latin-1"),
        (of_buffer("m/pipe"), "is a pipe"), *JSONS,
        (sample.gltf_text(extensionsRequired=["KHR_draco_mesh_compression"]), "requires KHR_draco_mesh_compression"),
        (sample.gltf_text(nodes=[]).replace('"nodes": []', '"nodes": [{}' + ",{}" * 2_000_001 + "]", 1), "more than"),
        *(of_buffer(uri) for uri in ("data:;base64,!!!", "http://x/y.bin", "a%00b", "m/circle")),
    ],
    ("mesh", "a.glb"): [
        glb()[:-1], glb()[:12] + b"\xff\xff\xff\x7f" + glb()[16:], struct.pack("<4sII", b"glTF", 1, 20) + b"\0" * 8,
        glb(DEEP),
        (glb(data=DATA.replace(ONE, SIGNALLING)), "not finite"),
        *(header_of(accessors=[{"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3"} | change] * 2)
          for change in ({"count": HUGE}, {"count": -1}, {"componentType": 7}, {"bufferView": 9})),
        header_of(accessors=[sample.gltf_header()["accessors"][0],
        {"componentType": 5125, "count": HUGE, "type": "SCALAR"}]), header_of(accessors=[]),
        header_of(buffers=None),
        header_of(bufferViews=[{"buffer": 7, "byteLength": 48}] * 2),
        header_of(bufferViews=[{"buffer": 0, "byteOffset": HUGE, "byteLength": 48}] * 2),
        *(header_of(nodes=nodes) for nodes in (
            [{"children": [1] * 40}] * 2, [*({"children": [k + 1, k + 1]} for k in range(60)), {"mesh": 0}],
            [{"children": [0], "mesh": 0}], [{"mesh": 0, "scale": [1e300] * 3}], [{"mesh": 0, "rotation": [0, 0, 0, 0]}], [{"mesh": 7}],
        )),
        header_of(scene=7),
        header_of(meshes=[{"primitives": [{"attributes": {"POSITION": 0}, "mode": 0}]}]),
        header_of(asset={"version": "1.0"}),
    ],
    # what meshes draw in must lie in the data set's folder, and be there
    ("set", "m/chair.obj"): [(OBJ.replace("a.mtl", uri), words) for uri, words in URIS.items()],
    ("set", "m/box.gltf"): [
        *((of_buffer(uri), words) for uri, words in URIS.items()),
        *(of_buffer(uri) for uri in (5, "https://x/y.bin", ".", "pipe", "gone.bin", "sparse")),
        *JSONS[:4],
    ],
    ("set", "dataset.yaml"): [
        *((text, "nested more than 64 deep") for text in (DEEP, "- " * 2000 + "a", "{a: " * 500 + "1" + "}" * 500)),
        ("format: " + "1" * 5000, "expected `int`, got `str`"), ("format: !!int 1", "the tag 'tag:yaml.org,2002:int' is not known"),
        ("format: !!python/tuple [1]", "the tag 'tag:yaml.org,2002:python/tuple' is not known"),
        ("format: *none", "found undefined alias"),
        ("format: 1\n---\nformat: 2\n", "another document"), ("format: \x07", "not YAML"),
        ("\x00\x00\x00", "not YAML"),
        (yaml.safe_dump(DATASET) + "results: {red: 1}\n", "results"),
        *(yaml.safe_dump(DATASET | {key: 1}) for key in ("x` - at `$.b[3]", "a\n\nb", "x" * 100_000)),
    ],
    ("set", "truth.yaml"): [(edited(TRUTH, *place, value=value), words) for *place, value, words in (
        ("materials", "red", "roughness", -7, "0 to 1|roughness"),
        ("materials", "red", "specular", [1.5, 0.1, 0.1], "specular"),
        ("materials", "red", "diffuse", [0.5, -0.1, 0.1], "diffuse"),
        ("poses", "hall", "vase", "translation", [0, 0, 1e300], "translation"),
        ("poses", "hall", "vase", "rotation", [[2, 0, 0]] * 3, "rotation"),
    )],
    ("mask", "mask.png"): [
        *((content, "not readable as a picture") for content in (b"", b"GIF89a", sample.MASK[:40],
        sample.MASK[:16] + bytes(99))),
        (sample.MASK[:33] + sample.chunk(b"zTXt", b"a\0\0" + zlib.compress(bytes(200_000_000))) + sample.MASK[33:], "not readable as a picture"),
        (long_png(), "the mask is 30000 × 30000 pixels, the photo 16 × 12"), (rows(bytes(range(48)), kind=2), "colour"),
        (rows(bytes([7] * W)), "unknown label 7"), (rows(bytes(W)), "the mask is empty"),
    ],
    ("mask", "labelme.json"): [
        *({"shapes": [{"label": "red", "points": points}]} for points in ([], [[1, 1]], [[1, 1], [2, 900], [9, 9]], [[1]])),
        {"shapes": [{"label": "red", "points": [[1, 1]], "shape_type": "rectangle"}]}, *JSONS,
    ],
    ("mask", "coco.json"): [
        *(coco(shape) for shape in BAD_SHAPES), (coco([ZIGZAG]), "pixels long"),
        (coco(*[[[0, 0, W, 0, W, H, 0, H]] * 400] * 400), "all outlines together are"),
        *(coco([[2, 2, 8, 2, 8, 8]], image=i) for i in ({"file_name": 5}, {"id": None}, {"width": 10**15})), *JSONS,
        '{"images": 5}',
    ],
    ("masks", "7.png"): [(long_png(kind=2), "900 megapixels; at most 200"), (sample.PHOTO[:-30], "truncated or damaged")],
    ("masks", "a.exr"): [(widened(60_000, 30_000), "megapixels|million values")],
    ("photo", "8.png"): [(b"no photo", "8.png"), (long_png(kind=2), "megapixels")],
    ("photo", "mask.png"): [(rows(bytes(W), height=H + 1), "the mask is 16 × 13 pixels, the photo 16 × 12")],
    ("objects", "m/chair.obj"): [
        (OBJ.replace("g shell", "g shell2"), "has no material|no part 'shell'"),
        (OBJ.replace("v 1.0", "v nan"), "not finite"),
    ],
    ("objects", "buffers/b 1.bin"): [(DATA[:30], "has 30 bytes, but the header states 72")],
    ("true maps", "albedo.exr"): [(widened(60_000, 30_000), "million values"), (channels(R=0, G=0, B=2), "albedo.room")],
    ("true maps", "normals.exr"): [(widened(60_000, 30_000), "million values")],
    ("true maps", "light.exr"): [
        (widened(60_000, 30_000), "million values"),
        (widened(2000, 1500, R=1, G=1, B=1, **{f"C{k:03}": 0 for k in range(900)}), "million values"),
    ],
    ("colmap", "model/cameras.bin"): [
        *((sample.cameras_bin(cameras=n), NO_MODEL) for n in (2, 2**40, 2**64 - 1)),
        (sample.cameras_bin(params=(300.0,)), NO_MODEL),
        (sample.cameras_bin(model=77), "77 is not the number of a camera model"), (sample.cameras_bin(width=0), "is not a camera"),
        (sample.cameras_bin(params=(float("nan"), 104.0, 71.0)), "is not a camera"),
        *((sample.cameras_bin(params=params), "is implausible") for params in ((1e-300, 104.0, 71.0), (300.0, 1e9, 71.0))),
    ],
    ("colmap", "model/images.bin"): [
        *((sample.images_bin(images=n), NO_MODEL) for n in (2, 2**40, 2**64 - 1)),
        (sample.images_bin(points=2**63), NO_MODEL),
        *((sample.images_bin(numbers=numbers), "is not a pose") for numbers in ((0.0,) * 7, (*sample.POSE[:6], float("inf")))),
        (sample.images_bin(camera_id=9), "has camera 9"),
    ],
    ("colmap text", "text/cameras.txt"): [
        b"1", *(sample.CAMERAS_TXT.replace(old, new) for old, new in ((b" 300 ", b" "), (b"SIMPLE_PINHOLE", b"NONE"),
        (b"200", LONG.encode()))),
    ],
    ("colmap text", "text/images.txt"): [b"\xff\xfe\x00", *(sample.IMAGES_TXT.replace(b".7 ", new) for new in (b"nan ",
    b"one "))],
    ("transforms", "t.json"): [
        *JSONS, '{"frames": null}', '{"w": ' + LONG + "}", '{"frames": [[]]}',
        *(transforms(matrix) for matrix in ([[1e300, 0, 0, 0]] * 3, [[0] * 4] * 3, [], [[1, 0, 0]] * 3)),
        *(({"w": 200, "h": 150, "camera_angle_x": angle, "frames": transforms()["frames"]}, r"frames\[0\]")
          for angle in (0.0, -1.0, 1e-300, 4.0)),
        *((transforms(w=w), r"\bw\b") for w in (1e30, 1e12, -200, 0.4)),
        *((transforms(fl_x=f), "fl_x") for f in (1e300, 1e-300, -3)),
        (transforms(cx=1e9), "cx"), (transforms(k1=1e14), "image_undistorter"),
        (transforms(camera_model="X" * 10_000), "camera_model"),
    ],
    ("bop", "model/scene_camera.json"): [
        *(({name: {"cam_K": sample.CAM_K}}, "not the id of an image") for name in ("²", "", "-1", LONG)), [],
        ({"7": {"cam_K": [1e300, 0, 103.5, 0, 1e300, 70.5, 0, 0, 1.0]}}, "cam_K"),
        ({"7": {"cam_K": [300, 0, 1e9, 0, 300, 70.5, 0, 0, 1.0]}}, "cam_K"),
    ],
    ("bop", "model/scene_gt.json"): [
        *(({"7": [sample.GT | {key: value}]}, key) for key, value in (("cam_t_m2c", [0, 0, 1e300]), ("obj_id", "5"))), {"7": sample.GT},
    ],
    ("true light", "light.exr"): [(channels((4, 8), R=[value] + 7 * [1], G=1, B=1), "hall") for value in (np.nan, np.inf, -7.0, -0.1)],
    ("true normals", "n.exr"): [
        (channels(R=0, G=0), "has no channel B"), (channels(**{"normal.x": 0, "normal.y": 0}),
        "has no channel normal.z"),
        (channels((6, 8), R=0, G=0, B=1), "normals.hall: has 8 × 6 pixels, the photo 16 × 12"),
        (channels(R=0, G=0, B=np.inf), "infinite"),
    ],
    ("true albedo", "n.exr"): [
        (channels(R=0, G=0), "albedo.hall: has no channel B"),
        (channels((6, 8), R=0, G=0, B=1), "albedo.hall: has 8 × 6 pixels, the photo 16 × 12"),
        *((channels(R=0, G=0, B=value), "albedo.hall: an albedo is") for value in (np.inf, -0.1, 1.2)),
    ],
    ("observations", "a.parquet"): [
        (with_values(material=np.full(5, 1)), "'material' has an index without a name"),
        (with_values(photo=np.full(5, -1)), "'photo' has an index without a name"),
        (with_values(exposures=(1.0, 2.0)), "exposure for each photo"), (rewritten("weight"), "0 columns 'weight'"),
        (rewritten("x", pa.array([HUGE] * 5)), "not readable"),
        (rewritten("weight", pa.array([1.0, None, 1.0, 1.0, 1.0])), "'weight' has missing values"),
        (rewritten("weight", pa.array(["a"] * 5)), "of type string"),
        (rewritten("normal", pa.FixedSizeListArray.from_arrays(pa.array(np.zeros(10)), 2)), "'normal' is of type"),
        (rewritten("normal", pa.array([[b"ab"] * 3] * 5, pa.list_(pa.binary(2), 3))), "'normal' is of type"),
        (rewritten("visibility", pa.array([b"x" * 10_000] * 5, pa.binary(10_000))), "'visibility' is of type"),
    ],
    ("lobes", "a.parquet"): [
        (many_rows, "200,000,000 rows; at most 100,000,000 are read"),
        (nameless_lobes, "an illumination that the metadata do not name"),
    ],
    ("yaml", "a.yaml"): [(text, "more than 2,000 values") for text in (LAUGHS, "[" + "a," * 100_000 + "]")],
    ("json", "a.json"): [(text, "not readable as JSON") for text in (DEEP, LONG, "", "\x00", "{'a': 1}")],
    ("poses", "poses.json"): [(text, "poses.json") for text in ("[]",
    '{"a": {"camera": {"focal_px": -1}, "objects": {}}}')],
}  # fmt: skip


def work(folder, reader, name):
    """Read it, soon; a warning that names our source is no word to a user."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        began = time.process_time()
        try:
            READERS.get(reader, reader)(folder, name)
        finally:
            assert time.process_time() - began < MOST_SECONDS


@pytest.mark.parametrize("reader, name", REFUSED)
def test_it_is_refused_by_name_soon_and_in_little_memory(folder, reader, name):
    for case in REFUSED[reader, name]:
        content, words = case if isinstance(case, tuple) else (case, ".")
        with sample.changed(folder, name, content) as path:
            size = path.stat().st_size if path.exists() else 0
            tracemalloc.start()
            try:
                error = refusal(words, work, folder, reader, name)
                assert (
                    tracemalloc.get_traced_memory()[1] < 60_000_000 + 40 * size
                )  # bytes: of a file of some kB, and of more
            finally:
                tracemalloc.stop()
        assert error.file and "\n" not in error.fault and not RAW.search(error.fault) and len(str(error)) < 1500


GOOD = [
    ("set", "dataset.yaml"), ("set", "truth.yaml"), ("set", "m/box.gltf"), ("mask", "coco.json"),
    *(("mask", f"mask.{kind}") for kind in ("png", *PICTURES[:-1])),
    ("mask", "labelme.json"),
    ("photo", "7.png"), ("observations", "observations.parquet"), ("lobes", "solve/lobes.parquet"),
    ("poses", "poses.json"), ("objects", "m/chair.obj"), *(("mesh", name) for name in sample.MESHES),
]  # fmt: skip
OF_CAMERAS = [
    ("colmap", "model/cameras.bin"), ("colmap", "model/images.bin"), ("colmap text", "text/images.txt"),
    ("transforms", "t.json"), ("bop", "model/scene_camera.json"), ("bop", "model/scene_gt.json"),
]  # fmt: skip
KINDS = {
    "pipe": lambda path: (path.unlink(), os.mkfifo(path)),
    "device": lambda path: (path.unlink(), path.symlink_to("/dev/zero")),
    "folder": lambda path: (path.unlink(), path.mkdir()),
    "link in a circle": lambda path: (path.unlink(), path.symlink_to(path.name)),
    "terabyte": lambda path: os.truncate(path, 1 << 40),
}


def test_a_good_file_is_read_and_what_is_no_plain_file_of_a_sane_size_is_never_opened(folder):
    """Whoever opened it would wait for ever, or fill the memory.  Of some files no limit on the size is promised."""
    for reader, name in GOOD + OF_CAMERAS:
        work(folder, reader, name)
        for kind in KINDS if reader in ("set", "mask", "mesh", "objects") else list(KINDS)[:-1]:
            with sample.changed(folder, name, KINDS[kind]):
                assert refusal(".", work, folder, reader, name).file, (reader, name, kind)


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can become another user")
def test_what_another_user_may_not_read_says_so():
    with tempfile.TemporaryDirectory() as home:
        os.chmod(home, 0o755)
        folder = make_set(Path(home) / "set")
        for reader, name in GOOD:
            READERS[reader](folder, name)  # loads what another user may not: Python may lie in root's home
            (folder / name).chmod(0)
            os.seteuid(65534)  # nobody
            try:
                if os.access(__file__, os.R_OK, effective_ids=True):  # of a checkout that is closed to others
                    refusal("Permission denied", work, folder, reader, name)
            finally:
                os.seteuid(0)
            (folder / name).chmod(0o644)


TEXTURED = {
    "images": [{"uri": "m/pipe"}, {"uri": "/dev/zero"}],
    "textures": [{"source": 0}],
    "materials": [{"name": "red", "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
}
DOTS = [{"size": [H, W], "counts": [k, 1, H * W - k - 1]} for k in range(0, H * W, 2)] * 100
READ = [  # what is odd and legal: reader, file, what is in it
    ("mesh", "a.obj", OBJ.replace("vn 0 0 1", "vn nan inf 1e300")), ("mesh", "a.obj", OBJ + "v 1e9 0 0\n"),
    ("mesh", "a.obj", OBJ.replace("a.mtl", "m/pipe")),
    ("mesh", "a.off", OFF.replace("OFF\n", "OFF\n# Möbel\n").encode("latin-1")),
    ("mesh", "a.stl", STL_TEXT.replace("chair", "Stühle").encode("latin-1")),
    ("mesh", "a.ply", PLY_TEXT.replace("TextureFile a", "Möbel").encode("latin-1")),
    ("mesh", "a.gltf", sample.gltf_text(**TEXTURED)), ("mesh", "a.gltf", of_buffer("buffers/b%201.bin")),
    ("mesh", "a.glb", glb(sample.gltf_header("m/../buffers/b%201.bin") | TEXTURED, b"")),
    ("set", "m/a.mtl", "newmtl red\nmap_Kd m/pipe\nmap_Ks |touch pwned\nmap_Ns ../../../etc/passwd\n"),
    ("set", "m/box.gltf", sample.gltf_text(**TEXTURED)), ("mask", "coco.json", coco(*DOTS, [[2, 2, 8, 2, 8, 8]])),
    ("mask", "coco.json", {**json.loads(coco([[2, 2, 8, 2, 8, 8]])),
     "more": {"image_id": 8, "category_id": 1, "segmentation": {"size": [1, 1], "counts": "o" * 1000}}}),
    ("transforms", "t.json", transforms(stamp=1.7e18, note=[[[]]])),
    ("true light", "light.exr", channels((4, 8), R=[-1e-4] + 7 * [1], G=1, B=1)),  # what resampling leaves
    ("true normals", "n.exr", channels(**{f"normal.{axis}": np.nan for axis in "xyz"})),
    ("true albedo", "n.exr", channels(R=np.nan, G=0, B=1)),
    ("masks", "7.png", sample.PHOTO), ("true maps", "light.exr", lambda path: None),
    ("solution", "solve/materials.json", lambda path: None), ("json", "coco.json", sample.COCO),
]  # fmt: skip


def test_what_is_odd_and_legal_is_read_soon_and_opens_no_texture(folder):
    for reader, name, content in READ:
        with sample.changed(folder, name, content):
            work(folder, reader, name)


# ── the same checks for `make validate`, and before anything runs ────────────────────────────────────────────────────


def told(verb, capsys) -> str:
    """The words with which a verb is refused."""
    try:
        code, text = verb(), capsys.readouterr().err
    except InputError as error:
        code, text = 1, f"error: {error}"
    assert code == 1, text
    return text


FAULTS = {  # file -> what is in it, and words of the error
    "7.png": (sample.PHOTO[:-30], "truncated or damaged"), "mask.png": (b"\x89PNG", "not readable as a picture"),
    "m/chair.obj": (OBJ.replace("v 1.0", "v nan"), "not finite"), "buffers/b 1.bin": (DATA[:30], "has 30 bytes, but the header states 72"),
}  # fmt: skip


def test_all_faults_are_said_at_once_and_each_once_without_running_anything(linked, tmp_path, capsys):
    folder = make_set(tmp_path / "set")
    look = lambda *settings: verbs.validate(linked, str(folder), list(settings))  # noqa: E731
    assert look("align.limits.triangles=4") == 0
    assert "4 triangles" in told(lambda: look("align.limits.triangles=3"), capsys)
    for name, (content, _) in FAULTS.items():
        put(folder / name, content)
    for verb in (look, lambda: verbs.make(linked, verbs.Request(str(folder)))):
        text = told(verb, capsys)
        assert all(words in text for _, words in FAULTS.values())
        assert len(re.findall("^error: ", text, re.MULTILINE)) == 4 and "4 faults" in text
    assert not list((linked.root / "build").glob("set/*")), "something was run"


CORNERS = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n"
OF_RECIPES = {
    "not_a_map.hdr": (b"no map", "not readable as an image"), "black.exr": (np.zeros((8, 16, 3)), "the map is black"),
    "square.exr": (np.ones((8, 8, 3)), "a lat-long map is twice as wide as high"),
    "holes.exr": (np.full((8, 16, 3), np.nan), "are NaN, infinite or above"), "faceless.obj": (CORNERS, "the mesh has no faces"),
    "flat.obj": (CORNERS + b"f 1 1 2\n", "every face has zero area"),
    "cut.ply": (b"ply\nformat ascii 1.0\n", "does not begin with the header of a PLY"),
}  # fmt: skip


def test_a_file_of_a_recipe_is_refused_before_anything_runs(linked, tmp_path, capsys):
    folder = make_set(tmp_path / "set")
    for name, (content, words) in OF_RECIPES.items():
        write_rgb_exr(folder / name, content) if isinstance(content, np.ndarray) else put(folder / name, content)
        wanted = f"lights: [{name}]\nkind: relight" if name.endswith(("hdr", "exr")) else f"mesh: {name}\nkind: insert"
        wish = verbs.Request(str(folder), ["render"], recipes=[str(put(folder / "own.yaml", wanted))])
        text = told(lambda wish=wish: verbs.make(linked, wish), capsys)
        assert re.search(words, text, re.DOTALL) and str(folder / name) in text and "\n  " in text, text
    assert not list((linked.root / "build").glob("set/*")), "something was run"


# ── spoiled at random ──

FUZZ_SECONDS = float(os.environ.get("FUZZ_SECONDS", "600"))
RAW = re.compile(r"\A\Z|\b(Assertion|Attribute|Index|Key|Name|Type|Value)Error\b")  # nothing, or words of Python

NUMBERS = [0, -1, 255, 2**31, 2**63, 2**64, 10**30, 10**400, 1e300, -1e300, 1e-300, 5e-324, -0.0, 5126, 5123]
WORDS = [
    "", ".", "..", "/", "../x", "\0", "x" * 300, "é" * 200, "z/" * 3000, "²", "7", "NaN", "red.png", "model", "link.png",
    "pipe.png", "a\nb", "*a", "` - at `$.a[0]`", "!!int", "VEC3", "POSITION", "data:;base64,AAAA", "data:,x",
]  # fmt: skip
ODD = (
    st.none()
    | st.booleans()
    | st.sampled_from(NUMBERS + WORDS)
    | st.integers(-3, 300)
    | st.floats()
    | st.text(max_size=8)
)
BELOW = lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=4), inner, max_size=3)  # noqa: E731
ODDER = st.recursive(ODD, BELOW, max_leaves=6)
PIECES = [
    b"\xff" * 8, b"\0" * 8, b"\xff" * 4, b"\x7f\xff\xff\xff", b"\0\0\xc0\x7f", struct.pack("<Q", 10**9), b"[[[[", b'"',
    b"&a [*a]", b"\r", *(f" {word} ".encode() for word in (
        "0", "-1", "1e300", "1e999", "nan", "9" * 5000, "4294967295", "2.5", "²", "\0", "1" + "0" * 12, "v", "f", "usemtl",
        "mtllib", "element", "property list uchar", "face", "end_header", "OFF", "endsolid", "#", "\\", "1/2/3", "1//",
        "a" * 300, "ü", "../x",
    )),
]  # fmt: skip


def places(value, way=()):
    """The ways to every part of plain data."""
    yield way
    for key, item in value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ():
        yield from places(item, (*way, key))


@st.composite
def spoiled(draw, value):
    """Plain data with some parts replaced, removed, doubled or renamed."""
    value = copy.deepcopy(value)
    for _ in range(draw(st.integers(1, 3))):
        if not (ways := [way for way in places(value) if way]):
            break
        (*above, last), holder = draw(st.sampled_from(ways)), value
        for step in above:
            holder = holder[step]
        kind = draw(st.sampled_from(["replace"] * 5 + ["remove", "double", "rename"]))
        if kind == "replace":
            holder[last] = draw(ODDER)
        elif kind == "remove":
            del holder[last]
        elif kind == "rename" and isinstance(holder, dict):
            holder[draw(st.text(max_size=6) | st.sampled_from(["x" * 300, "a\0b"]))] = holder.pop(last)
        elif isinstance(holder, list):
            holder.insert(last, copy.deepcopy(holder[last]))
    return value


@st.composite
def spoiled_bytes(draw, content: bytes) -> bytes:
    """A file with bytes changed, cut out, doubled or put in, half of them in the header; cut at the end at times."""
    for _ in range(draw(st.integers(1, 4))):
        reach = len(content) if draw(st.booleans()) else min(len(content), 400)
        at, length = draw(st.integers(0, reach)), draw(st.sampled_from([0, 1, 1, 4, 8, 40]))
        new = draw(st.binary(max_size=6) | st.sampled_from([*PIECES, content[at : at + 60]]))
        content = content[:at] + new + content[at + length :]
    return content[: draw(st.integers(0, len(content)))] if draw(st.integers(0, 7)) == 0 else content


def yaml_of(value) -> bytes:
    return yaml.safe_dump(value, allow_unicode=True).encode("utf-8", "replace")


def spoiled_json(value, write=lambda value: json.dumps(value).encode()) -> st.SearchStrategy:
    """The text of plain data, spoiled before or after it was written."""
    return spoiled(value).map(write) | spoiled_bytes(write(value))


# ── who reads meshes, and how they are spoiled ──


def read_usable_mesh(folder, name: str) -> None:
    """What is read can be used: finite, unit normals, indices in range; by one material, or by the names of parts."""
    made_of = "red" if (folder / name).stat().st_size % 2 else {"red": "red", "shell": "red"}
    mesh = read_mesh(folder / name, ["red"], made_of)
    assert len(mesh.faces) and 0 <= mesh.faces.min() and mesh.faces.max() < len(mesh.vertices)
    assert np.isfinite(mesh.vertices).all() and np.isfinite(mesh.radius) and mesh.radius > 0
    assert np.abs(np.linalg.norm(mesh.normals, axis=1) - 1).max() < 1e-6 and set(mesh.labels) == {1}


def spoiled_mesh(name: str) -> st.SearchStrategy:
    if name not in ("a.gltf", "a.glb"):
        return spoiled_bytes(MESHES[name])
    header = spoiled(json.loads(sample.gltf_text())).map(json.dumps)
    return header.map(sample.glb if name == "a.glb" else str.encode) | spoiled_bytes(MESHES[name])


# ── what is spoiled, and who reads it ────────────────────────────────────────────────────────────────────────────────

PARTS_OF_PNG = (png_header(W, H, kind=3), sample.PIXELS, bytes(range(9)))
A_PNG = st.builds(png, *(spoiled_bytes(part) | st.just(part) for part in PARTS_OF_PNG))
PNG_KINDS = st.tuples(
    st.sampled_from([1, 2, 4, 8, 16]), st.sampled_from([0, 2, 3, 4, 6]), st.binary(min_size=50, max_size=800)
)
ANY_PNG = PNG_KINDS.map(lambda kind: png(png_header(W, H, *kind[:2]), zlib.compress(kind[2] * 4), PARTS_OF_PNG[2]))
SETS = st.sampled_from([{}, *({"cameras": source} for source in SOURCES.values())])
PLAIN_PARTS = {  # name -> the file that holds plain data as JSON, and who reads it
    "COCO": ("coco.json", "mask"), "labelme": ("labelme.json", "mask"), "transforms.json": ("t.json", "transforms"),
    "BOP cameras": ("model/scene_camera.json", "bop"), "BOP poses": ("model/scene_gt.json", "bop"),
    "earlier solution": ("solve/materials.json", "solution"), "earlier exposures": ("solve/exposures.json", "solution"),
    "earlier poses": ("poses.json", "poses"),
}  # fmt: skip
PARTS = {  # name -> (file, its contents, who reads it); None: the good file's bytes spoiled
    "dataset.yaml": ("dataset.yaml", SETS.flatmap(lambda more: spoiled_json(DATASET | more, yaml_of)), "set"),
    "truth.yaml": ("truth.yaml", spoiled(PLAIN["truth.yaml"]).map(yaml_of), "set"),
    "PNG": ("mask.png", A_PNG | ANY_PNG, "mask"),
    "COLMAP cameras": ("model/cameras.bin", None, "colmap"),
    "COLMAP images": ("model/images.bin", None, "colmap"),
    "COLMAP cameras as text": ("text/cameras.txt", None, "colmap text"),
    "COLMAP images as text": ("text/images.txt", None, "colmap text"),
    "observations": ("observations.parquet", None, "observations"),
    "lobes": ("solve/lobes.parquet", None, "lobes"),
    "true light": ("light.exr", None, "true light"),
    **{name: (file, spoiled_json(PLAIN[file]), reader) for name, (file, reader) in PLAIN_PARTS.items()},
    **{name: (name, spoiled_mesh(name), read_usable_mesh) for name in MESHES},
    **{f"mask.{kind}": (f"mask.{kind}", None, "mask") for kind in PICTURES},
    "photo": ("7.png", None, "masks"),
}


@pytest.fixture
def little_memory():
    with limited(resource.RLIMIT_AS, 16 << 30):  # of addresses, libraries included
        logging.disable(logging.WARNING)
        yield
        logging.disable(logging.NOTSET)


@contextlib.contextmanager
def limited(kind: int, most: int):
    """Within, the process has no more of something than `most`, or than what is allowed in any case."""
    before = resource.getrlimit(kind)
    resource.setrlimit(kind, (most if before[1] == resource.RLIM_INFINITY else min(most, before[1]), before[1]))
    try:
        yield
    finally:
        resource.setrlimit(kind, before)


def check(folder, reader, file: str) -> None:
    """The file is read or refused; the only exception that may come out is InputError, and no raw warning."""
    refused = None
    try:
        work(folder, reader, file)
    except InputError as error:
        refused = error
    assert refused is None or (
        refused.file and refused.cure and len(str(refused)) < 3000 and not RAW.search(refused.fault)
    )


def fuzz(folder, part: str, **options) -> None:
    file, contents, reader = PARTS[part]
    check(folder, reader, file)
    contents = spoiled_bytes((folder / file).read_bytes()) if contents is None else contents

    @settings(deadline=None, database=None, suppress_health_check=list(HealthCheck), print_blob=False, **options)
    @given(contents)
    def spoil(content):
        with sample.changed(folder, file, content):
            check(folder, reader, file)

    if not options.get("derandomize"):
        seed(time.time_ns())(spoil)
    spoil()


@pytest.mark.parametrize("part", PARTS)
def test_a_spoiled_file_is_read_or_refused(folder, little_memory, part):
    fuzz(folder, part, max_examples=8, derandomize=True, phases=(Phase.generate,))


@pytest.mark.long
@pytest.mark.parametrize("part", PARTS)
def test_thousands_of_spoiled_files_are_read_or_refused(folder, little_memory, part):
    end = time.monotonic() + FUZZ_SECONDS / len(PARTS)
    while time.monotonic() < end:
        fuzz(folder, part, max_examples=200)


# ── what means harm: it reads and writes nothing outside itself, runs no code and forges no report ───────────────────────

EVIL_HTML = "<script>alert(1)</script><img src=x onerror=alert(2)>"
EVIL_ANSI = "\x1b]0;owned\x07\x1b[2J\x1b[31mall is well\r\u202e"
CONTROL = re.compile(r"[\x00-\x09\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069]")


def refused(folder, spec=DATASET, truth=TRUTH) -> InputError:
    dataset, true = (yaml.safe_dump(each) for each in (spec, truth))
    with sample.changed(folder, "dataset.yaml", dataset), sample.changed(folder, "truth.yaml", true):
        error = refusal(".", read_dataset, folder)
    assert error.file and len(str(error)) < 1000
    return error


# ── it reads nothing outside itself, and nothing that never ends ─────────────────────────────────────────────────────

WAYS = {
    "../secret{}": OUTSIDE, "m/../../secret{}": OUTSIDE, "{folder}/../secret{}": OUTSIDE, "link{}": OUTSIDE, "m/link{}": OUTSIDE, "twice{}": OUTSIDE,
    "up/secret{}": OUTSIDE, "circle/a{}": NO_PATH, "x\0y{}": NO_PATH, "é" * 200 + "{}": NO_PATH,
    "z/" * 4000 + "{}": NO_PATH, "pipe{}": "is a pipe, not a file|there is no folder|no folder",
}  # fmt: skip


def test_no_path_leads_out_or_nowhere(folder):
    """Above, absolute, by a link, a link to a link or a folder that is one; in circles, or longer than names may be."""
    for place, (way, words) in ((place, each) for place in PATHS for each in WAYS.items()):
        path = way.format(PATHS[place], folder=folder)
        if place[0] not in TRUTH:
            error = refused(folder, edited(DATASET, *place, value=path))
            assert error.key == ".".join(map(str, place)).replace(".0", "[0]").replace(".1", "[1]")
        elif words == OUTSIDE:  # what is not there of a truth is a warning
            error = refused(folder, truth=edited(TRUTH, *place, value=path))
        else:
            continue
        assert re.search(words, error.fault), (place, way, error)


def test_a_given_folder_and_a_recipe_open_no_pipe_and_no_device(tmp_path):
    dataset = read_dataset(make_set(tmp_path / "set"))
    for kind in ("pipe", "device"):
        given = tmp_path / kind
        given.mkdir()
        for name in ("materials.json", "odd.obj", "odd.hdr", "odd.json"):
            os.mkfifo(given / name) if kind == "pipe" else (given / name).symlink_to("/dev/zero")
        project = Project(LIBRARY, photo_sets())
        refusal(f"is a {kind}", read_state, project, Request("synthetic", ["solve"], [f"solve.start={given}"]))
        for text in ("mesh: odd.obj\nkind: insert", "kind: relight\nlights: [odd.hdr]"):
            refusal("there is no file", read_recipe, put(given / "own.yaml", text), dataset)


# ── it writes nothing outside build/ ─────────────────────────────────────────────────────────────────────────────────

NAMES = [
    "../up", "a/b", ".", "", "a\0b", "a b", "~", "$(touch x)", "é", "a\n", "CON:", EVIL_HTML, "\x1b[31m", "n" * 101,
]  # fmt: skip
NAMED = [("photos", 0, "name"), ("photos", 0, "illumination"), ("photos", 0, "objects", 0, "name"), ("materials", 0)]


def test_names_that_become_names_of_files_are_plain_words_of_100_characters(folder):
    for place, name in ((place, name) for place in NAMED for name in NAMES):
        error = refused(folder, edited(DATASET, *place, value=name))
        assert error.key and not CONTROL.search(str(error).replace("\n", "")), (place, name)


def test_a_run_writes_nothing_but_results(linked, tmp_path):
    """Of the stage that reads what a stranger sends, over a data set whose folder has an odd name."""
    odd = make_set(tmp_path / "it's $(touch pwned) <b>&amp; `touch pwned`")

    def times():
        paths = {*tmp_path.rglob("*"), *linked.root.iterdir()} - {linked.build}
        return {path: path.lstat().st_mtime_ns for path in paths}

    before = times()
    assert verbs.make(linked, verbs.Request(str(odd), ["masks"])) == 0
    assert times() == before and (linked.build / odd.name / "masks" / "photos.json").exists()


# ── it runs no code ──────────────────────────────────────────────────────────────────────────────────────────────────


class Bomb:
    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return os.mkdir, (str(self.path),)


def test_a_checkpoint_is_never_run(tmp_path, caplog):
    torch.save({"a": Bomb(tmp_path / "pwned")}, tmp_path / "a.pt")
    assert Checkpoint(tmp_path / "a.pt").load() is None and "cannot be read" in caplog.text
    assert not (tmp_path / "pwned").exists()


# ── it forges no report ──────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("verb, of", [("validate", "name"), ("masks", "name"), ("validate", "key")])
def test_no_name_of_a_file_and_no_key_moves_the_cursor_or_sets_a_colour(linked, tmp_path, capfd, verb, of):
    folder = make_set(tmp_path / "set")
    put(folder / f"x{EVIL_ANSI}.png", "none")
    key, value = ("image", f"x{EVIL_ANSI}.png") if of == "name" else (f"key{EVIL_ANSI}", EVIL_ANSI)
    put(folder / "dataset.yaml", yaml.safe_dump(edited(DATASET, "photos", 0, key, value=value)))
    text = f"{call(linked, verb, '--dataset', str(folder))}{''.join(capfd.readouterr())}"
    assert not CONTROL.search(text) and "Traceback" not in text and "\\x1b[31mall is well" in text


def test_names_and_warnings_are_text_in_the_report(tmp_path):
    text = f"{EVIL_HTML}{EVIL_ANSI}.jpg: its colour profile is {EVIL_HTML!r}"
    inputs, usual = run(tmp_path, log=[], seen={"day": ["red"], "noon": ["red"]})
    facts = {**inputs.facts, "dataset.set": {**inputs.facts["dataset.set"], "name": EVIL_HTML}}
    put(tmp_path / "log.jsonl", json.dumps({"event": "warning", "stage": "masks", "photo": "day", "text": text}))
    page = page_of(msgspec.structs.replace(inputs, facts=facts), tmp_path / "evil")
    assert "<script>alert" not in page and "<img src=x" not in page and page.count("&lt;script&gt;alert(1)") >= 3
    assert page.count("<script") == usual.count("<script")


# ── writers that find no room ────────────────────────────────────────────────────────────────────────────────────────────

PIXELS = np.random.default_rng(0).random((48, 64, 3), dtype=np.float32)
CODES = (255 * PIXELS).astype(np.uint8)
LAYERS = Layers(torch.zeros(8), torch.ones(8), [torch.ones(32, 8), torch.ones(1, 32)], [torch.ones(32), torch.ones(1)])
WRITERS = {  # file -> who writes it, one for each way that bytes reach a disk; what stands after a blank tells those of one kind apart
    "a.exr": lambda path: write_exr(path, {f"n.{k}": PIXELS[..., 0] for k in range(7)}),
    "a.png": lambda path: write_png(path, CODES),
    "a.jpg": lambda path: write_bytes(path, encode_pixels(path, CODES, {"Compression": "jpeg:95"})),
    "a.json": lambda path: write_json(path, {"a": PIXELS.tolist()}),
    "a.json of the runner": lambda path: replace_file(path, b"{}" * 2000),
    "a.parquet": lambda path: write_observations(path, sample.observations(2000)),
    "a.safetensors": lambda path: write_layers(path, LAYERS),
    "a.pt": lambda path: Checkpoint(path).save({"a": torch.arange(3000.0)}),
}  # fmt: skip


def unlimited(write):
    with limited(resource.RLIMIT_FSIZE, resource.RLIM_INFINITY):
        return bytes_of(write)


@pytest.mark.parametrize("kind", WRITERS)
def test_a_file_that_finds_no_room_is_an_error_is_not_there_and_leaves_whole_what_it_would_replace(
    tmp_path, monkeypatch, kind
):
    path, write = tmp_path / kind.partition(" ")[0], WRITERS[kind]
    if (
        path.suffix == ".jpg"
    ):  # libjpeg ends the process where it finds no room, so it must never write to a disk itself
        monkeypatch.setattr("factorlib.images.exr.bytes_of", unlimited)
    write(path)
    size = path.stat().st_size
    for room in (size - 1, size // 2, 1):
        path.unlink()
        with limited(resource.RLIMIT_FSIZE, room), pytest.raises(Exception) as caught:
            write(path)
        assert not list(tmp_path.iterdir()), "a cut file is left behind"
        known = disk_error(caught.value, tmp_path)
        assert isinstance(known, InputError) and known.file == tmp_path and "MB are free" in known.fault, caught.value
        write(path)
        assert path.stat().st_size == size
    if kind in ("a.json of the runner", "a.pt"):
        path.write_bytes(b"old")
        with limited(resource.RLIMIT_FSIZE, size // 2), pytest.raises(OSError):
            write(path)
        assert path.read_bytes() == b"old" and list(tmp_path.iterdir()) == [path]


def test_a_quota_and_a_full_disk_in_a_librarys_words_are_the_users_to_mend(tmp_path):
    error = RuntimeError("a library: I/O error: No space left on device (os error 28)")
    assert "the disk is full" in disk_error(error, tmp_path).fault
    assert "quota is used up" in disk_error(OSError(errno.EDQUOT, "Disk quota exceeded"), tmp_path).fault
    assert disk_error(RuntimeError("another"), tmp_path) is None


# lines that write to a path; who may: the writers themselves, what is no result, what goes to memory, and logs of processes
WRITING = re.compile(
    r"\.(write_text|write_bytes|save_file|savefig|imwrite|tofile|savez|save_image|write_table)\(|ImageOutput\.create"
    r"|torch\.save\((?!.*stream)|\bopen\([^)]*[\"'](?=\w*[wax+])[rwaxbt+]+[\"']"
)
MAY = ("wholefile.py", "images/exr.py", "setup.py", "reflection/fused.py", "runner/worker.py")


def test_nothing_is_written_past_the_writers_that_check():
    files = {p for folder in ("factorlib", "stages", "studies") for p in (LIBRARY / folder).rglob("*.py")}
    for path in files - {LIBRARY / "factorlib" / name for name in MAY}:
        lines = path.read_text().splitlines()
        past = [line for before, line in zip(["", *lines], lines) if WRITING.search(line) and "writing(" not in before]
        assert not past, path
