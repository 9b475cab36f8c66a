"""A good data set with a file of every kind, results of an earlier run beside it, and who reads each.

Tests spoil one file at a time; `changed` puts it back.
"""

import base64
import contextlib
import io
import json
import os
import shutil
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path

import msgspec
import numpy as np
import yaml
from PIL import Image

from factorlib.dataset.read_dataset import read_dataset
from factorlib.dataset.schema import PhotoSlice
from factorlib.dataset.slices import SLICES, dataset_slice
from factorlib.evaluate.truth import read_true_albedo, read_true_light, read_true_normals
from factorlib.images.exr import write_exr, write_rgb_exr
from factorlib.jsonfile import read_json
from factorlib.labels.label_image import read_labels
from factorlib.light.lobes import Lobes
from factorlib.meshes.read_mesh import read_mesh
from factorlib.results.lobe_table import read_lobes, write_lobes
from factorlib.results.poses import read_poses
from factorlib.results.solution import read_earlier_solution
from factorlib.stage import Inputs
from factorlib.urm.observations import Observations, read_observations, write_observations
from factorlib.validation import Validation
from factorlib.yamlfile import read_yaml
from stages import masks

W, H = 16, 12
EYE = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
NINE = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]

# ── meshes: a tetrahedron in every format ────────────────────────────────────────────────────────────────────────────

VERTICES = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], float)
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
ROWS = "".join("{} {} {}\n".format(*v) for v in VERTICES)
TRIANGLES = "".join("3 {} {} {}\n".format(*f) for f in FACES)
OBJ = "mtllib a.mtl\no chair\ng shell\nusemtl red\n{}vn 0 0 1\n{}".format(
    "".join(f"v {row}\n" for row in ROWS.splitlines()),
    "".join("f {} {}//1 {}\n".format(*(f + 1)) for f in FACES),
)
OFF = f"OFF\n4 4 0\n{ROWS}{TRIANGLES}"
FACET = "facet normal 0 0 0\nouter loop\n{}endloop\nendfacet\n"
CORNERS = ["".join("vertex {} {} {}\n".format(*VERTICES[v]) for v in face) for face in FACES]
STL_TEXT = f"solid chair\n{''.join(FACET.format(corners) for corners in CORNERS)}endsolid chair\n"
STL = struct.pack("<80sI", b"a" * 80, 4) + b"".join(
    struct.pack("<12fH", 0, 0, 0, *VERTICES[face].ravel(), 0) for face in FACES
)
PLY_HEADER = """ply
format {} 1.0
comment TextureFile a.png
element vertex 4
property float x
property float y
property float z
element face 4
property list uchar int vertex_indices
end_header
"""
PLY_TEXT = PLY_HEADER.format("ascii") + ROWS + TRIANGLES
PLY_FACES = b"".join(b"\3" + f.astype("<i4").tobytes() for f in FACES)
PLY = PLY_HEADER.format("binary_little_endian").encode() + VERTICES.astype("<f4").tobytes() + PLY_FACES
DATA = VERTICES.astype("<f4").tobytes() + FACES.astype("<u2").tobytes()


def gltf_header(uri: str | None = None) -> dict:
    """The header of a glTF whose one buffer is DATA."""
    return {
        "asset": {"version": "2.0"},
        "buffers": [{"byteLength": len(DATA)} | ({"uri": uri} if uri is not None else {})],
        "bufferViews": [{"buffer": 0, "byteLength": 48}, {"buffer": 0, "byteOffset": 48, "byteLength": 24}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3", "min": [0, 0, 0], "max": [1, 1, 1]},
            {"bufferView": 1, "componentType": 5123, "count": 12, "type": "SCALAR"},
        ],
        "materials": [{"name": "red"}],
        "meshes": [{"name": "shell", "primitives": [{"attributes": {"POSITION": 0}, "indices": 1, "material": 0}]}],
        "nodes": [{"name": "chair", "mesh": 0}],
        "scenes": [{"nodes": [0]}],
        "scene": 0,
    }


def gltf_text(**changes) -> str:
    """A glTF with its buffer within."""
    return json.dumps(gltf_header("data:application/octet-stream;base64," + base64.b64encode(DATA).decode()) | changes)


def glb(header: dict | str | None = None, data: bytes = DATA) -> bytes:
    text = (header if isinstance(header, str) else json.dumps(header or gltf_header())).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0") + data
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


MESHES = {
    "a.obj": OBJ.encode(), "a.off": OFF.encode(), "a.stl": STL_TEXT.encode(), "b.stl": STL, "a.ply": PLY_TEXT.encode(),
    "b.ply": PLY, "a.gltf": gltf_text().encode(), "a.glb": glb(),
}  # fmt: skip

# ── masks ────────────────────────────────────────────────────────────────────────────────────────────────────────────


def chunk(name: bytes, data: bytes) -> bytes:
    """A chunk of a PNG, with its length and check sum."""
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))


def png_header(width: int, height: int, bits: int = 8, kind: int = 0) -> bytes:
    return struct.pack(">IIBBBBB", width, height, bits, kind, 0, 0, 0)


def png(header: bytes, pixels: bytes, palette: bytes = b"", before: bytes = b"") -> bytes:
    """A PNG of the contents of its chunks; `before` stands before its pixels."""
    colours = chunk(b"PLTE", palette) if palette else b""
    return (
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + colours + before + chunk(b"IDAT", pixels) + chunk(b"IEND", b"")
    )


LABEL = np.zeros((H, W), np.uint8)
LABEL[2:6, 2:14], LABEL[7:11, 3:12] = 1, 2
PIXELS = zlib.compress(b"".join(b"\0" + row.tobytes() for row in LABEL))
MASK = png(png_header(W, H), PIXELS)
PICTURES = ("tiff", "bmp", "gif", "tga", "webp", "jpeg")  # formats of masks besides PNG


def picture(kind: str, values: np.ndarray) -> bytes:
    Image.fromarray(values).save(stream := io.BytesIO(), kind, lossless=True)
    return stream.getvalue()


RED = png(png_header(W, H), zlib.compress(b"".join(b"\0" + row.tobytes() for row in np.uint8(255) * (LABEL == 1))))
PHOTO = png(png_header(W, H, kind=2), zlib.compress(b"".join(b"\0" + bytes(range(60, 60 + 3 * W)) for _ in range(H))))
COCO = {
    "images": [{"id": 7, "file_name": "7.png", "width": W, "height": H}, {"id": 8, "file_name": "8.png"}],
    "categories": [{"id": 1, "name": "red"}, {"id": 2, "name": "wood"}],
    "annotations": [
        {"image_id": 7, "category_id": 1, "segmentation": [[1.0, 1.0, 6.0, 1.0, 6.0, 6.0], [1, 8, 4, 8, 4, 11, 1, 11]]},
        {"image_id": 7, "category_id": 2, "segmentation": {"size": [H, W], "counts": [120, 5, 67]}},
        {"image_id": 7, "category_id": 2, "segmentation": {"size": [H, W], "counts": "R47g1"}},
        {"image_id": 8, "category_id": 2, "segmentation": []},
    ],
}


def coco(*segmentations, image: dict | None = None) -> bytes:
    """A COCO file of shapes of one material in the photo 7.png."""
    shapes = [{"image_id": 7, "category_id": 1, "segmentation": each} for each in segmentations]
    return json.dumps({**COCO, "images": [COCO["images"][0] | (image or {})], "annotations": shapes}).encode()


# ── cameras from elsewhere ───────────────────────────────────────────────────────────────────────────────────────────

POSE = (0.7, 0.1, -0.5, 0.5, 1.0, 2.0, 3.0)  # a unit quaternion and a translation


def cameras_bin(cameras=1, model=0, width=200, height=150, params=(300.0, 104.0, 71.0)) -> bytes:
    return struct.pack("<QIiQQ", cameras, 1, model, width, height) + struct.pack(f"<{len(params)}d", *params)


def images_bin(images=1, points=0, numbers=POSE, camera_id=1) -> bytes:
    return struct.pack("<QI7dI", images, 1, *numbers, camera_id) + b"7.png\0" + struct.pack("<Q", points)


CAMERAS_TXT = b"# cameras\n1 SIMPLE_PINHOLE 200 150 300 104 71\n"
IMAGES_TXT = b"# images\n1 .7 .1 -.5 .5 1 2 3 1 7.png\n1 2 3\n"
LENS = {"fl_x": 300.0, "fl_y": 300.0, "cx": 104.0, "cy": 71.0, "w": 200, "h": 150, "k1": 0.0, "camera_model": "OPENCV"}
MATRIX = [[*row, 5.0] for row in EYE]
TRANSFORMS = {
    **LENS,
    "frames": [
        {"file_path": "7.png", "transform_matrix": [*MATRIX, [0, 0, 0, 1]]},
        {"file_path": "./8", "camera_angle_x": 0.7, "is_fisheye": False, "k2": 1e-5, "transform_matrix": MATRIX},
    ],
}
CAM_K = [300.0, 0.0, 103.5, 0.0, 300.0, 70.5, 0.0, 0.0, 1.0]
GT = {"obj_id": 5, "cam_R_m2c": NINE, "cam_t_m2c": [0.0, 0.0, 1500.0]}
SOURCES = {
    "bop": {"bop": "model", "images": {"hall": 7}, "obj_ids": {"vase": 5}, "mesh_unit_mm": 1000.0},
    "transforms": {"transforms": "t.json", "images": {"hall": "7.png"}, "world_from_camera": True},
    "colmap": {
        "colmap": "model",
        "world_from_object": {"vase": {"scale": 2.0, "rotation": EYE, "translation": [0, 0, 1.0]}},
    },
}

# ── the data set, its truth, and results of an earlier run ───────────────────────────────────────────────────────────

KEYPOINTS = [{"pixel": [1.0 * k, 5.0 * (k % 2)], "point": p} for k, p in enumerate([[0.0] * 3, *EYE])]
PLACE = {"rotation": EYE, "translation": [0.0, 0.0, 2.5]}
HALL = {
    "name": "hall", "image": "7.png", "encoding": "srgb", "illumination": "hall", "world_from_camera": EYE,
    "masks": {"red": "red.png"},
    "objects": [
        {"name": "vase", "mesh": "vase", "mask": "red.png", "pose": PLACE},
        {"name": "chair", "mesh": "chair", "materials": {"shell": "wood"}, "keypoints": KEYPOINTS},
    ],
}  # fmt: skip
ROOM = {
    "name": "room", "image": "8.png", "masks": "mask.png", "camera": {"focal_px": 812.0, "principal_point": [8.0, 6.0]},
    "objects": [{"name": "vase", "mesh": "vase"}, {"name": "box", "mesh": "box"}],
}  # fmt: skip
DATASET = {
    "format": 1,
    "materials": ["red", "wood"],
    "meshes": {
        "chair": {"file": "m/chair.obj", "parts": {"shell": "red"}},
        "vase": {"file": "vase.ply", "material": "red"},
        "box": {"file": "m/box.gltf", "parts": {"chair": "wood"}},
    },
    "photos": [HALL, ROOM],
    "truth": "truth.yaml",
}
TRUTH = {
    "materials": {"red": {"diffuse": [0.5, 0.1, 0.1], "specular": [0.1, 0.1, 0.1], "roughness": 0.3}},
    "illumination": {"hall": "light.exr"},
    "normals": {"room": "normals.exr"},
    "albedo": {"room": "albedo.exr"},
    "poses": {"hall": {"vase": PLACE}},
}
SOLUTION = {
    "materials": {
        "red": {
            **TRUTH["materials"]["red"],
            "alpha": 0.09,
            "stderr": {"diffuse": [0.1] * 3, "specular": [0.1] * 3, "roughness": 0.1},
        }
    },
    "gauge": {"component": {"red": 0}},
    "model": {"specular": {"red": True}, "self_shadowing": True, "tone": {"hall": {"exponent": 1.0, "pivot": 0.5}}},
}
POSES = {
    "hall": {
        "camera": {
            "focal_px": 300.0,
            "principal_point": [8.0, 6.0],
            "focal_source": "exif",
            "focal_relative_stderr": 0.1,
        },
        "objects": {
            "vase": {"rotation": EYE, "translation": [0.0, 0.0, 2.0], "scale": [1.0, 1.0, 1.0], "runner_up": None}
        },
    }
}
PLAIN = {  # name -> what is written as JSON or YAML
    "labelme.json": {"shapes": [{"label": "red", "points": [[1, 1], [6, 6]], "shape_type": "rectangle"}], "imageHeight": H},
    "truth.yaml": TRUTH, "coco.json": COCO, "t.json": TRANSFORMS,
    "model/scene_camera.json": {str(k): {"cam_K": CAM_K, "depth_scale": 1.0} for k in (7, 8)},
    "model/scene_gt.json": {str(k): [GT] for k in (7, 8)},
    "solve/materials.json": SOLUTION, "solve/exposures.json": {"hall": [1.0, 1.0, 1.0]}, "poses.json": POSES,
}  # fmt: skip
CONTENT = {
    "7.png": PHOTO, "8.png": PHOTO, "mask.png": MASK, "red.png": RED, "m/chair.obj": OBJ.encode(),
    "m/a.mtl": b"newmtl red\n",
    "m/box.gltf": json.dumps(gltf_header("../buffers/b%201.bin")).encode(), "buffers/b 1.bin": DATA, "vase.ply": PLY,
    "model/cameras.bin": cameras_bin(), "model/images.bin": images_bin(), "text/cameras.txt": CAMERAS_TXT,
    "text/images.txt": IMAGES_TXT,
    **MESHES, **{f"mask.{kind}": picture(kind, LABEL * np.uint8(255 if kind == "jpeg" else 1)) for kind in PICTURES},
    **{name: json.dumps(value).encode() for name, value in PLAIN.items()},
}  # fmt: skip


def observations(n: int = 5) -> Observations:
    unit = np.random.default_rng(0).normal(size=(2, n, 3))
    normal, view = unit / np.linalg.norm(unit, axis=2, keepdims=True)
    zero, radiance, visibility = np.zeros(n, int), np.random.default_rng(1).random((n, 3)), np.full((n, 8), 255, "u1")
    unclipped = np.zeros((n, 3), bool)
    return Observations(
        *(normal, view, radiance, unclipped, zero, zero, zero, zero, zero, np.ones(n)),
        *(("red",), ("hall",), ("hall",), visibility),
    )


def make_set(folder: Path) -> Path:
    """The data set, with its truth, every other file that is read, and what never must be opened."""
    for name, content in CONTENT.items():
        put(folder / name, content)
    (folder / "dataset.yaml").write_text(yaml.safe_dump(DATASET))
    write_rgb_exr(folder / "light.exr", np.ones((4, 8, 3)))
    write_exr(folder / "normals.exr", {f"normal.{a}": np.full((H, W), v, np.float32) for a, v in zip("xyz", (0, 0, 1))})
    write_rgb_exr(folder / "albedo.exr", np.full((H, W, 3), 0.3))
    write_lobes(folder / "solve" / "lobes.parquet", {"hall": Lobes(np.eye(3), np.ones(3), np.ones((3, 3)))})
    write_observations(folder / "observations.parquet", observations())
    return folder


def put(path: Path, content: bytes | str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


@contextlib.contextmanager
def changed(folder: Path, name: str, content: object) -> Iterator[Path]:
    """Within, a file is another: of those bytes, of that text, of plain data, or what a function of its path makes."""
    path = folder / name
    before = path.read_bytes() if path.is_file() else None
    if callable(content):
        content(path)
    else:
        put(path, content if isinstance(content, (bytes, str)) else json.dumps(content))
    try:
        yield path
    finally:
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        elif os.path.lexists(path):
            path.unlink()
        if before is not None:
            put(path, before)


def edited(tree: object, *place, value: object) -> object:
    """Plain data with the value at a place replaced; what is missing on the way there is made, None takes it away."""
    tree = json.loads(json.dumps(tree))
    at = tree
    for step in place[:-1]:
        if isinstance(at, dict) and not isinstance(at.get(step), dict | list):
            at[step] = {}
        at = at[step]
    if value is None:
        del at[place[-1]]
    else:
        at[place[-1]] = value
    return tree


# ── who reads what ───────────────────────────────────────────────────────────────────────────────────────────────────


def read_set(folder: Path) -> None:
    """As a plan does: the data set, and every slice of it."""
    dataset = read_dataset(folder)
    for name in SLICES:
        for photo in (None, *(photo.name for photo in dataset.spec.photos)):
            json.dumps(dataset_slice(dataset, name, photo).facts)


def with_cameras(source: str, **more: str):
    """The data set read with its cameras from elsewhere."""

    def read(folder: Path, _: str) -> None:
        with changed(folder, "dataset.yaml", yaml.safe_dump(DATASET | {"cameras": SOURCES[source] | more})):
            read_set(folder)

    return read


def run_masks(folder: Path, name: str) -> None:
    """The stage `masks` of a photo, whose image, mask or mask of an object is the file."""
    image = "7.png" if name == "mask.png" else name
    photo = PhotoSlice(
        image=image,
        encoding=None,
        masks="mask.png",
        labels=["red", "wood"],
        focal_px=None,
        illumination="a",
        objects=[],
    )
    files = {path.name: path for path in folder.iterdir() if path.is_file()}
    facts = {"dataset.photo": msgspec.to_builtins(photo), "dataset.materials": DATASET["materials"]}
    (folder / "out").mkdir(exist_ok=True)
    masks.main(masks.Params(), Inputs({}, facts, files, "hall"), folder / "out")


def validated(slice_: str):
    """The first fault that `make validate` finds."""

    def read(folder: Path, _: str) -> None:
        for fault in Validation(read_dataset(folder)).faults([(slice_, None, {}, folder)]):
            raise fault

    return read


READERS = {  # reader -> who reads a file of the data set's folder
    "set": lambda folder, _: read_set(folder),
    "colmap": with_cameras("colmap"),
    "colmap text": with_cameras("colmap", colmap="text"),
    "transforms": with_cameras("transforms"),
    "bop": with_cameras("bop"),
    "mesh": lambda folder, name: read_mesh(folder / name, ["red"], "red"),
    "mask": lambda folder, name: read_labels(name, lambda path: folder / path, ["red", "wood"], (H, W), "photos/7.png"),
    "masks": run_masks,
    "photo": validated("photo"),
    "objects": validated("objects"),
    "true maps": validated("truth"),
    "true light": lambda folder, name: read_true_light(folder / name, "hall"),
    "true normals": lambda folder, name: read_true_normals(folder / name, "hall", (W, H)),
    "true albedo": lambda folder, name: read_true_albedo(folder / name, "hall", (W, H)),
    "observations": lambda folder, name: read_observations(folder / name),
    "lobes": lambda folder, name: read_lobes(folder / name),
    "solution": lambda folder, _: read_earlier_solution(folder / "solve"),
    "poses": lambda folder, name: read_poses(folder / name),
    "json": lambda folder, name: read_json(folder / name),
    "yaml": lambda folder, name: read_yaml(folder / name, dict, most_values=2000),
}
