"""Whatever a file holds, it is read or refused by an InputError, soon: files of every kind spoiled at random.

What earlier searches found stands in `test_hostile_input`.  `make test` spoils some hundred files, always the same; the
long test goes on for FUZZ_SECONDS (600), shared by its parts, each time with others.
"""

from __future__ import annotations

import copy
import io
import json
import logging
import os
import resource
import struct
import time
import warnings
import zlib

import numpy as np
import OpenImageIO as oiio
import pillow_heif
import pytest
import yaml
from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st
from PIL import Image

from factorlib.errors import InputError
from factorlib.images.limits import check_pixels, check_values
from factorlib.images.photo import decoded, open_photo
from factorlib.meshes.read import read_mesh
from tests.faults import good
from tests.faults.good import DATASET, MESHES, PLAIN, READERS, SOURCES, H, W, png, png_header

LONG = float(os.environ.get("FUZZ_SECONDS", "600"))
FEW, MANY = 8, 200
MOST_SECONDS = 20  # of processor time, for one file
MOST_MEMORY = 16 << 30  # of addresses, libraries included

# ── spoiling ─────────────────────────────────────────────────────────────────────────────────────────────────────────

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


# ── good pictures, and who reads them and meshes ─────────────────────────────────────────────────────────────────────

COLOURS = np.random.default_rng(0).random((30, 40, 3), dtype=np.float32)
PICTURES = {  # file -> Pillow's name of the kind, or the type of OpenImageIO's values, and options
    "photo.jpg": ("JPEG", {"quality": 80}), "progressive.jpg": ("JPEG", {"progressive": True}), "photo.png": ("PNG", {}),
    "photo.tif": ("TIFF", {"compression": "tiff_lzw"}), "photo.heic": ("HEIF", {}),
    "photo.dng": ("TIFF", {"tiffinfo": {50706: b"\1\4\0\0", 262: 32803}}),
    "deep.png": ("uint16", {}), "float.tif": ("float", {"compression": "zip"}), "photo.exr": ("half", {"compression": "zip"}),
    "piz.exr": ("float", {"compression": "piz"}), "tiles.exr": ("half", {"tile": 16}), "photo.hdr": ("float", {}),
}  # fmt: skip


def write_picture(path, kind: str, options: dict) -> None:
    """As Pillow writes it, with notes of a camera, or OpenImageIO."""
    if kind.isupper():
        pillow_heif.register_heif_opener()
        stream, exif = io.BytesIO(), Image.Exif()
        exif[0x0112], exif[0x010F] = 6, "maker"
        exif.get_ifd(0x8769)[0x920A] = 50.0
        Image.fromarray((255 * COLOURS).astype(np.uint8)).save(stream, kind, exif=exif, **options)
        path.write_bytes(stream.getvalue())
        return
    spec, output = oiio.ImageSpec(40, 30, 3, kind), oiio.ImageOutput.create(str(path))
    spec.tile_width = spec.tile_height = options.get("tile", 0)
    spec.attribute("compression", options.get("compression", "zip"))
    assert output.open(str(path), spec)
    assert output.write_tiles(0, 40, 0, 30, 0, 1, COLOURS) if "tile" in options else output.write_image(COLOURS)
    output.close()


def read_picture(folder, name: str) -> None:
    """As validation and the stages do: the header, the limits, then the pixels."""
    stored = open_photo(folder / name, "image")
    check_pixels(stored.size, 2.0, folder / name, "image")
    check_values(folder / name, 2.0, "image")
    photo = decoded(stored, None, 1, folder / name)
    assert np.isfinite(photo.radiance).all() and photo.radiance.shape == (photo.height, photo.width, 3)


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
    header = spoiled(json.loads(good.gltf_text())).map(json.dumps)
    return header.map(good.glb if name == "a.glb" else str.encode) | spoiled_bytes(MESHES[name])


# ── what is spoiled, and who reads it ────────────────────────────────────────────────────────────────────────────────

PARTS_OF_PNG = (png_header(W, H, kind=3), good.PIXELS, bytes(range(9)))
A_PNG = st.builds(png, *(spoiled_bytes(part) | st.just(part) for part in PARTS_OF_PNG))
KINDS = st.tuples(
    st.sampled_from([1, 2, 4, 8, 16]), st.sampled_from([0, 2, 3, 4, 6]), st.binary(min_size=50, max_size=800)
)
ANY_PNG = KINDS.map(lambda kind: png(png_header(W, H, *kind[:2]), zlib.compress(kind[2] * 4), PARTS_OF_PNG[2]))
SETS = st.sampled_from([{}, *({"cameras": source} for source in SOURCES.values())])
PLAIN_PARTS = {  # name -> the file that holds plain data as JSON, and who reads it
    "COCO": ("coco.json", "mask"), "transforms.json": ("t.json", "transforms"),
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
    **{name: (name, None, read_picture) for name in PICTURES},
}
QUICK = [part for part in PARTS if part not in PICTURES or part in ("photo.jpg", "photo.exr")]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = good.make_set(tmp_path_factory.mktemp("fuzz") / "set")
    os.mkfifo(folder / "pipe.png")
    (folder / "link.png").symlink_to("/etc/passwd")
    (folder / "x").symlink_to("x")
    for name, how in PICTURES.items():
        write_picture(folder / name, *how)
    return folder


@pytest.fixture(autouse=True)
def little_memory():
    before = resource.getrlimit(resource.RLIMIT_AS)
    most = MOST_MEMORY if before[1] == resource.RLIM_INFINITY else min(MOST_MEMORY, before[1])
    resource.setrlimit(resource.RLIMIT_AS, (most, before[1]))
    logging.disable(logging.WARNING)
    yield
    logging.disable(logging.NOTSET)
    resource.setrlimit(resource.RLIMIT_AS, before)


def check(read, folder, file: str) -> None:
    """The file is read or refused; the only exception that may come out is InputError, and no raw warning."""
    began, refused = time.process_time(), None
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            read(folder, file)
        except InputError as error:
            refused = error
    assert refused is None or (refused.file and refused.found and refused.cure and len(str(refused)) < 3000)
    assert time.process_time() - began < MOST_SECONDS


def fuzz(folder, part: str, **options) -> None:
    file, contents, reader = PARTS[part]
    read = READERS.get(reader, reader)
    check(read, folder, file)
    contents = spoiled_bytes((folder / file).read_bytes()) if contents is None else contents

    @settings(deadline=None, database=None, suppress_health_check=list(HealthCheck), print_blob=False, **options)
    @given(contents)
    def spoil(content):
        with good.changed(folder, file, content):
            check(read, folder, file)

    if not options.get("derandomize"):
        seed(time.time_ns())(spoil)
    spoil()


@pytest.mark.parametrize("part", [pytest.param(p, marks=() if p in QUICK else pytest.mark.long) for p in PARTS])
def test_a_spoiled_file_is_read_or_refused(folder, part):
    fuzz(folder, part, max_examples=FEW, derandomize=True, phases=(Phase.generate,))


@pytest.mark.long
@pytest.mark.parametrize("part", PARTS)
def test_thousands_of_spoiled_files_are_read_or_refused(folder, part):
    end = time.monotonic() + LONG / len(PARTS)
    while time.monotonic() < end:
        fuzz(folder, part, max_examples=MANY)
