"""Whatever a dataset's files hold, they are read or refused by an InputError: files spoiled at random, thousands of them.

What earlier runs found stands as tests of its own in the other modules of this folder.  `make test` spoils a few hundred
files, always the same; the long test goes on for FUZZ_SECONDS (600), shared by its parts, and each time with others.
"""

from __future__ import annotations

import copy
import json
import logging
import os
import struct
import time
import warnings
import zlib
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import yaml
from faults.tries import note
from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st
from PIL import Image

from factorlib.dataset.read import read_dataset
from factorlib.dataset.slices import SLICES, dataset_slice
from factorlib.errors import InputError
from factorlib.labels import read_labels
from factorlib.light.lobes import Lobes
from factorlib.results.lobes import read_lobes, write_lobes
from factorlib.results.poses import read_poses
from factorlib.results.solution import read_earlier as read_earlier_solution
from factorlib.urm.observations import Observations, read_observations, write_observations

LONG = float(os.environ.get("FUZZ_SECONDS", "600"))
SHORT_EXAMPLES, LONG_EXAMPLES = 25, 200
MOST_SECONDS = 20  # of processor time, for one file
H, W = 12, 16
EYE = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
NINE = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]

# ── spoiling ─────────────────────────────────────────────────────────────────────────────────────────────────────────

ODD = (
    st.none()
    | st.booleans()
    | st.sampled_from([0, -1, 255, 256, 2**31, 2**63, 2**64, 10**30, 10**400, -(10**20), 1e300, -1e300, 1e-300, 5e-324, 0.0, -0.0])
    | st.integers(-3, 300)
    | st.floats()
    | st.sampled_from(["", ".", "..", "/", "../x", "\0", "a\0b", "x" * 300, "é" * 200, "z/" * 3000, "²", "-", "7", "NaN", "hall.png", "model"])
    | st.sampled_from(["round.png", "pipe.png", "out.png", "` - at `$.a[0]`", "a\nb", "mask.json", "*a", "!!int"])
    | st.text(max_size=8)
)
ODDER = st.recursive(ODD, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=4), inner, max_size=3), max_leaves=6)


def places(value, way=()):
    """The ways to every part of plain data."""
    yield way
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, item in items:
        yield from places(item, (*way, key))


@st.composite
def spoiled(draw, value):
    """Plain data with some parts replaced, removed, doubled or renamed."""
    value = copy.deepcopy(value)
    for _ in range(draw(st.integers(1, 3))):
        ways = [way for way in places(value) if way]
        if not ways:
            break
        *above, last = draw(st.sampled_from(ways))
        holder = value
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
    """A file with bytes changed, cut out or put in, numbers made huge; cut at the end at times."""
    for _ in range(draw(st.integers(1, 4))):
        at, length = draw(st.integers(0, len(content))), draw(st.sampled_from([0, 1, 1, 4, 8, 30]))
        huge = st.sampled_from([b"\xff" * 8, b"\0" * 8, b"\xff" * 4, struct.pack("<Q", 10**9), struct.pack("<d", 1e300), b"\x7f", b"[[[[", b'"', b"&a [*a]"])
        new = draw(st.binary(max_size=6) | huge)
        content = content[:at] + new + content[at + length :]
    return content[: draw(st.integers(0, len(content)))] if draw(st.integers(0, 7)) == 0 else content


# ── good files ───────────────────────────────────────────────────────────────────────────────────────────────────────

DATASET = {
    "format": 1,
    "materials": ["red", "wood"],
    "meshes": {"chair": {"file": "chair.obj", "parts": {"shell": "red", "legs": "wood"}}, "vase": {"file": "vase.ply", "material": "red"}},
    "photos": [
        {
            "name": "hall",
            "image": "7.png",
            "encoding": "srgb",
            "illumination": "hall",
            "world_from_camera": EYE,
            "masks": {"red": "mask.png"},
            "camera": {"focal_px": 812.0, "principal_point": [320.0, 240.0]},
            "objects": [
                {"name": "vase", "mesh": "vase", "mask": "mask.png", "pose": {"rotation": EYE, "translation": [0.0, 0.0, 2.5]}},
                {"name": "chair", "mesh": "chair", "materials": {"shell": "wood"}, "keypoints": [
                    {"pixel": [1.0, 1.0], "point": [0.0, 0.0, 0.0]}, {"pixel": [5.0, 1.0], "point": [1.0, 0.0, 0.0]},
                    {"pixel": [5.0, 4.0], "point": [1.0, 1.0, 0.0]}, {"pixel": [1.0, 4.0], "point": [0.0, 1.0, 1.0]},
                ]},
            ],
        },
        {"name": "room", "image": "8.png", "masks": "mask.png", "objects": [{"name": "vase", "mesh": "vase"}, {"name": "two", "mesh": "chair"}]},
    ],
    "truth": "truth.yaml",
}  # fmt: skip
SOURCES = {
    "bop": {"bop": "model", "images": {"hall": 7}, "obj_ids": {"vase": 5}, "mesh_unit_mm": 1000.0},
    "transforms": {"transforms": "t.json", "images": {"hall": "7.png"}, "world_from_camera": True},
    "colmap": {"colmap": "model", "world_from_object": {"vase": {"scale": 2.0, "rotation": EYE, "translation": [0.0, 0.0, 1.0]}}},
}
TRUTH = {
    "materials": {"red": {"diffuse": [0.5, 0.1, 0.1], "specular": [0.1, 0.1, 0.1], "roughness": 0.3}},
    "illumination": {"hall": "map.exr"},
    "normals": {"room": "map.exr"},
    "poses": {"hall": {"vase": {"rotation": EYE, "translation": [0.0, 0.0, 2.5]}}},
}
TRANSFORMS = {
    "fl_x": 300.0, "fl_y": 300.0, "cx": 104.0, "cy": 71.0, "w": 200, "h": 150, "k1": 0.0, "camera_model": "OPENCV",
    "frames": [
        {"file_path": "7.png", "transform_matrix": [*([*row, 5.0] for row in EYE), [0, 0, 0, 1]]},
        {"file_path": "./8", "camera_angle_x": 0.7, "is_fisheye": False, "k2": 1e-5, "transform_matrix": [[*row, 5.0] for row in EYE]},
    ],
}  # fmt: skip
SCENE_CAMERA = {str(k): {"cam_K": [300.0, 0.0, 103.5, 0.0, 300.0, 70.5, 0.0, 0.0, 1.0], "depth_scale": 1.0} for k in (7, 8)}
SCENE_GT = {str(k): [{"obj_id": 5, "cam_R_m2c": NINE, "cam_t_m2c": [0.0, 0.0, 1500.0]}] for k in (7, 8)}
COCO = {
    "images": [{"id": 7, "file_name": "7.png", "width": W, "height": H}, {"id": 8, "file_name": "8.png"}],
    "categories": [{"id": 1, "name": "red"}, {"id": 2, "name": "wood"}],
    "annotations": [
        {"id": 1, "image_id": 7, "category_id": 1, "segmentation": [[1.0, 1.0, 6.0, 1.0, 6.0, 6.0], [1, 8, 4, 8, 4, 11, 1, 11]]},
        {"id": 2, "image_id": 7, "category_id": 2, "segmentation": {"size": [H, W], "counts": [120, 5, 67]}},
        {"id": 3, "image_id": 7, "category_id": 2, "segmentation": {"size": [H, W], "counts": "R47g1"}},
        {"id": 4, "image_id": 8, "category_id": 2, "segmentation": []},
    ],
}
QUATERNION = (0.7, 0.1, -0.5, 0.5)
CAMERAS_BIN = struct.pack("<QIiQQ3d", 1, 1, 0, 200, 150, 300.0, 104.0, 71.0)
IMAGES_BIN = struct.pack("<Q", 2) + b"".join(
    struct.pack("<I7dI", k, *QUATERNION, 1.0, 2.0, 3.0, 1) + name + struct.pack("<Q2dQ", 1, 1.0, 2.0, 3) for k, name in ((1, b"7.png\0"), (2, b"8.png\0"))
)
CAMERAS_TXT = b"# cameras\n1 PINHOLE 200 150 300 300.1 104 71\n2 RADIAL 200 150 300 104 71 0.0001 0\n"
IMAGES_TXT = b"# images\n1 .7 .1 -.5 .5 1 2 3 1 7.png\n1 2 3\n2 .7 .1 -.5 .5 1 2 3 2 8.png\n\n"
STDERR = {"diffuse": [0.1, 0.1, 0.1], "specular": [0.1, 0.1, 0.1], "roughness": 0.1}
MATERIALS_JSON = {
    "materials": {"red": {"diffuse": [0.5, 0.1, 0.1], "specular": [0.1, 0.1, 0.1], "roughness": 0.3, "alpha": 0.09, "stderr": STDERR}},
    "gauge": {"component": {"red": 0}},
    "model": {"specular": {"red": True}, "self_shadowing": True, "self_shadowing_chosen_by": {"on": 1.0}, "tone": {"hall": {"exponent": 1.0, "pivot": 0.5}}},
}
POSES_JSON = {
    "hall": {
        "camera": {"focal_px": 300.0, "principal_point": [8.0, 6.0], "focal_source": "exif", "focal_relative_stderr": 0.1},
        "objects": {"vase": {"rotation": EYE, "translation": [0.0, 0.0, 2.0], "scale": [1.0, 1.0, 1.0], "runner_up": None}},
    }
}


def observations(n: int = 5) -> Observations:
    rng = np.random.default_rng(0)
    unit = rng.normal(size=(2, n, 3))
    normal, view = unit / np.linalg.norm(unit, axis=2, keepdims=True)
    zero = np.zeros(n, int)
    return Observations(
        normal, view, rng.uniform(size=(n, 3)), np.zeros((n, 3), bool), zero, zero, zero, zero, zero, np.ones(n),
        ("red",), ("hall",), ("hall",), np.full((n, 8), 255, "u1"),
    )  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("fuzz") / "set"
    (folder / "model").mkdir(parents=True)
    for name in ("7.png", "8.png", "hall.png", "map.exr", "vase.ply"):
        (folder / name).write_bytes(b"")
    (folder / "chair.obj").write_text("usemtl shell\n")
    Image.fromarray(np.eye(H, W, dtype=np.uint8)).save(folder / "mask.png")
    (folder / "round.png").symlink_to("round.png")
    (folder / "out.png").symlink_to("/etc/passwd")
    os.mkfifo(folder / "pipe.png")
    restore(folder)
    return folder


def restore(folder: Path, source: str | None = None) -> None:
    """Every file good again."""
    good = DATASET | ({"cameras": SOURCES[source]} if source else {})
    (folder / "dataset.yaml").write_text(yaml.safe_dump(good))
    (folder / "truth.yaml").write_text(yaml.safe_dump(TRUTH))
    (folder / "m.png").write_bytes(png(HEADER, PALETTE, PIXELS))
    for name, value in (("t.json", TRANSFORMS), ("coco.json", COCO), ("model/scene_camera.json", SCENE_CAMERA), ("model/scene_gt.json", SCENE_GT)):
        (folder / name).write_text(json.dumps(value))
    for name, content in (("cameras.bin", CAMERAS_BIN), ("images.bin", IMAGES_BIN), ("cameras.txt", CAMERAS_TXT), ("images.txt", IMAGES_TXT)):
        (folder / "model" / name).write_bytes(content)
    for name, value in (("materials.json", MATERIALS_JSON), ("exposures.json", {"hall": [1.0, 1.0, 1.0]}), ("poses.json", POSES_JSON)):
        (folder / name).write_text(json.dumps(value))
    write_lobes(folder / "lobes.parquet", {"hall": Lobes(np.eye(3), np.ones(3), np.ones((3, 3)))})
    write_observations(folder / "observations.parquet", observations())


# ── what is spoiled, and who reads it ────────────────────────────────────────────────────────────────────────────────


def read_set(folder: Path) -> None:
    """As a plan does: the dataset, and every slice of it."""
    dataset = read_dataset(folder)
    for name in SLICES:
        for photo in (None, *(photo.name for photo in dataset.spec.photos)):
            json.dumps(dataset_slice(dataset, name, photo).facts)


def read_mask(folder: Path, name: str) -> None:
    read_labels(name, lambda path: folder / path, ["red", "wood"], (H, W), "photos/7.png")


def text_of(value) -> bytes:
    return json.dumps(value).encode()


def yaml_of(value) -> bytes:
    return yaml.safe_dump(value, allow_unicode=True).encode("utf-8", "replace")


def png(header: bytes, palette: bytes, pixels: bytes) -> bytes:
    """Of the contents of its chunks, each with its check sum, as a hostile one would have."""
    chunks = ((b"IHDR", header), (b"PLTE", palette), (b"IDAT", pixels), (b"IEND", b""))
    packed = (struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data)) for name, data in chunks)
    return b"\x89PNG\r\n\x1a\n" + b"".join(packed)


HEADER = struct.pack(">IIBBBBB", W, H, 8, 3, 0, 0, 0)
PIXELS = zlib.compress(b"".join(b"\0" + bytes([1] * W) for _ in range(H)))
PALETTE = bytes(range(9))
A_PNG = st.builds(png, spoiled_bytes(HEADER) | st.just(HEADER), spoiled_bytes(PALETTE) | st.just(PALETTE), spoiled_bytes(PIXELS) | st.just(PIXELS))
KINDS = st.tuples(st.sampled_from([1, 2, 4, 8, 16]), st.sampled_from([0, 2, 3, 4, 6]), st.binary(min_size=50, max_size=800))
ANY_PNG = KINDS.map(lambda kind: png(struct.pack(">IIBBBBB", W, H, kind[0], kind[1], 0, 0, 0), PALETTE, zlib.compress(kind[2] * 4)))

A_DATASET = st.sampled_from([None, *SOURCES]).flatmap(lambda name: spoiled(DATASET | ({"cameras": SOURCES[name]} if name else {})))
MODEL = "model"
PARTS = {  # name -> (file, source, its contents, reader)
    "dataset.yaml": ("dataset.yaml", None, A_DATASET.map(yaml_of), read_set),
    "text of dataset.yaml": ("dataset.yaml", None, spoiled_bytes(yaml_of(DATASET)), read_set),
    "truth.yaml": ("truth.yaml", None, spoiled(TRUTH).map(yaml_of), read_set),
    "PNG": ("m.png", None, A_PNG | ANY_PNG, lambda folder: read_mask(folder, "m.png")),
    "COCO": ("coco.json", None, spoiled(COCO).map(text_of), lambda folder: read_mask(folder, "coco.json")),
    "text of COCO": ("coco.json", None, spoiled_bytes(text_of(COCO)), lambda folder: read_mask(folder, "coco.json")),
    "COLMAP cameras": ("model/cameras.bin", "colmap", spoiled_bytes(CAMERAS_BIN), read_set),
    "COLMAP images": ("model/images.bin", "colmap", spoiled_bytes(IMAGES_BIN), read_set),
    "COLMAP cameras as text": ("model/cameras.txt", "colmap text", spoiled_bytes(CAMERAS_TXT), read_set),
    "COLMAP images as text": ("model/images.txt", "colmap text", spoiled_bytes(IMAGES_TXT), read_set),
    "transforms.json": ("t.json", "transforms", spoiled(TRANSFORMS).map(text_of) | spoiled_bytes(text_of(TRANSFORMS)), read_set),
    "BOP cameras": ("model/scene_camera.json", "bop", spoiled(SCENE_CAMERA).map(text_of) | spoiled_bytes(text_of(SCENE_CAMERA)), read_set),
    "BOP poses": ("model/scene_gt.json", "bop", spoiled(SCENE_GT).map(text_of) | spoiled_bytes(text_of(SCENE_GT)), read_set),
    "observations": ("observations.parquet", None, None, lambda folder: read_observations(folder / "observations.parquet")),
    "lobes": ("lobes.parquet", None, None, lambda folder: read_lobes(folder / "lobes.parquet")),
    "earlier solution": ("materials.json", None, spoiled(MATERIALS_JSON).map(text_of), read_earlier_solution),
    "earlier exposures": ("exposures.json", None, spoiled({"hall": [1.0, 1.0, 1.0]}).map(text_of), read_earlier_solution),
    "earlier poses": ("poses.json", None, spoiled(POSES_JSON).map(text_of), lambda folder: read_poses(folder / "poses.json")),
}


CAME = Counter()  # of the files so far: how many were read, how many refused


def read_or_refused(read, folder: Path) -> None:
    """The only exception that may come out is InputError; and no raw warning."""
    begin, refused = time.process_time(), None
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            read(folder)
        except InputError as error:
            refused = error
    assert refused is None or (refused.found and refused.cure and len(str(refused)) < 3000)
    assert time.process_time() - begin < MOST_SECONDS
    CAME["refused" if refused else "accepted"] += 1


def fuzz(folder: Path, part: str, **options) -> None:
    file, source, contents, read = PARTS[part]
    restore(folder, (source or "").split(" ")[0] or None)
    if source == "colmap text":
        for name in ("cameras.bin", "images.bin"):
            (folder / MODEL / name).unlink()
    contents = contents if contents is not None else spoiled_bytes((folder / file).read_bytes())
    read(folder) if (folder / file).exists() else None  # what is good is read

    @settings(deadline=None, database=None, suppress_health_check=list(HealthCheck), print_blob=False, **options)
    @given(contents)
    def spoil(content):
        (folder / file).write_bytes(content)
        read_or_refused(read, folder)

    if not options.get("derandomize"):
        seed(time.time_ns())(spoil)
    logging.disable(logging.WARNING)
    CAME.clear()
    try:
        spoil()
    finally:
        logging.disable(logging.NOTSET)
    note("fuzz", part, CAME.total(), **CAME)


@pytest.mark.parametrize("part", PARTS)
def test_a_spoiled_file_is_read_or_refused(folder, part):
    fuzz(folder, part, max_examples=SHORT_EXAMPLES, derandomize=True, phases=(Phase.generate,))


@pytest.mark.long
@pytest.mark.parametrize("part", PARTS)
def test_thousands_of_spoiled_files_are_read_or_refused(folder, part):
    end = time.monotonic() + LONG / len(PARTS)
    while time.monotonic() < end:
        fuzz(folder, part, max_examples=LONG_EXAMPLES)
