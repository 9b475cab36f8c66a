"""Whatever a file holds, it is read or refused by an InputError, soon: files of every kind spoiled at random, thousands of them.

What earlier searches found stands in `test_hostile_input`.  `make test` spoils a few hundred files, always the same; the
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
from collections import Counter

import numpy as np
import OpenImageIO as oiio
import pytest
import yaml
from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st
from PIL import Image

from factorlib.errors import InputError
from factorlib.images.limits import check_pixels, check_values
from factorlib.images.photo import decoded, open_photo
from factorlib.meshes import read_mesh
from tests.faults.good import (
    CAMERAS_TXT,
    COCO,
    DATASET,
    IMAGES_TXT,
    LABEL,
    MESHES,
    PIXELS,
    PLAIN,
    READERS,
    SOURCES,
    TRANSFORMS,
    H,
    W,
    cameras_bin,
    changed,
    glb,
    gltf_text,
    images_bin,
    make_set,
    png,
    png_header,
)
from tests.faults.tries import note

LONG = float(os.environ.get("FUZZ_SECONDS", "600"))
FEW, MANY = 25, 200
MOST_SECONDS = 20  # of processor time, for one file
MOST_MEMORY = 16 << 30  # of addresses, libraries included

# ── spoiling ─────────────────────────────────────────────────────────────────────────────────────────────────────────

NUMBERS = [0, -1, 255, 2**31, 2**63, 2**64, 10**30, 10**400, 1e300, -1e300, 1e-300, 5e-324, -0.0, 5126, 5123]
WORDS = ["", ".", "..", "/", "../x", "\0", "x" * 300, "é" * 200, "z/" * 3000, "²", "7", "NaN", "red.png", "model"]
WORDS += [
    "link.png",
    "pipe.png",
    "` - at `$.a[0]`",
    "a\nb",
    "*a",
    "!!int",
    "VEC3",
    "POSITION",
    "data:;base64,AAAA",
    "data:,x",
]
ODD = (
    st.none()
    | st.booleans()
    | st.sampled_from(NUMBERS + WORDS)
    | st.integers(-3, 300)
    | st.floats()
    | st.text(max_size=8)
)
ODDER = st.recursive(
    ODD,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=4), inner, max_size=3),
    max_leaves=6,
)
HUGE = [
    b"\xff" * 8,
    b"\0" * 8,
    b"\xff" * 4,
    b"\x7f\xff\xff\xff",
    b"\0\0\xc0\x7f",
    struct.pack("<Q", 10**9),
    b"[[[[",
    b'"',
    b"&a [*a]",
]
TOKENS = ["0", "-1", "5", "1e300", "1e999", "nan", "9" * 5000, "4294967295", "2.5", "", "²", "\0", "1" + "0" * 12]
TOKENS += [
    "v",
    "f",
    "usemtl",
    "g",
    "mtllib",
    "element",
    "property",
    "list",
    "uchar",
    "face",
    "end_header",
    "OFF",
    "endsolid",
]
TOKENS += ["#", "\\", "1/2/3", "1//", "a" * 300, "ü", "../x"]


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
    """A file with bytes changed, cut out, doubled or put in, half of them where headers are; cut at the end at times."""
    for _ in range(draw(st.integers(1, 4))):
        reach = len(content) if draw(st.booleans()) else min(len(content), 400)
        at, length = draw(st.integers(0, reach)), draw(st.sampled_from([0, 1, 1, 4, 8, 40]))
        new = draw(st.binary(max_size=6) | st.sampled_from([*HUGE, content[at : at + 60]]))
        content = content[:at] + new + content[at + length :]
    return content[: draw(st.integers(0, len(content)))] if draw(st.integers(0, 7)) == 0 else content


@st.composite
def spoiled_words(draw, content: bytes) -> bytes:
    """A text with words and lines replaced, doubled and removed."""
    lines = [line.split(b" ") for line in content.split(b"\n")]
    for _ in range(draw(st.integers(1, 5))):
        line = draw(st.integers(0, len(lines) - 1))
        word = draw(st.integers(0, max(len(lines[line]) - 1, 0)))
        kind = draw(st.sampled_from(["word"] * 4 + ["double", "remove", "cut"]))
        if kind == "word":
            lines[line][word : word + 1] = [
                draw(st.sampled_from(TOKENS) | st.text(max_size=9)).encode("utf-8", "replace")
            ]
        elif kind == "double":
            lines.insert(draw(st.integers(0, len(lines))), list(lines[line]))
        elif kind == "remove" and len(lines) > 1:
            del lines[line]
        else:
            del lines[line][word:]
    return draw(st.sampled_from([b"\n", b"\n", b"\r\n", b"\r"])).join(b" ".join(words) for words in lines)


def text_of(value) -> bytes:
    return json.dumps(value).encode()


def yaml_of(value) -> bytes:
    return yaml.safe_dump(value, allow_unicode=True).encode("utf-8", "replace")


# ── good pictures ────────────────────────────────────────────────────────────────────────────────────────────────────

COLOURS = np.random.default_rng(0).random((30, 40, 3), dtype=np.float32)


def by_pillow(kind: str, **options: object) -> bytes:
    """A picture as Pillow writes it, with notes of a camera."""
    stream, exif = io.BytesIO(), Image.Exif()
    exif[0x0112], exif[0x010F] = 6, "maker"
    exif.get_ifd(0x8769)[0x920A] = 50.0
    Image.fromarray((255 * COLOURS).astype(np.uint8)).save(stream, kind, exif=exif, **options)
    return stream.getvalue()


def by_oiio(name: str, kind: str, tile: int = 0, **attributes: str):
    """A picture as OpenImageIO writes it into a folder."""

    def write(folder) -> bytes:
        path, spec = folder / f"by-oiio-{name}", oiio.ImageSpec(40, 30, 3, kind)
        spec.tile_width = spec.tile_height = tile
        for key, value in attributes.items():
            spec.attribute(key, value)
        output = oiio.ImageOutput.create(str(path))
        assert output.open(str(path), spec)
        assert output.write_image(COLOURS) if not tile else output.write_tiles(0, 40, 0, 30, 0, 1, COLOURS)
        output.close()
        return path.read_bytes()

    return write


def heif(_) -> bytes:
    import pillow_heif

    pillow_heif.register_heif_opener()
    return by_pillow("HEIF")


PICTURES = {
    "photo.jpg": lambda _: by_pillow("JPEG", quality=80),
    "progressive.jpg": lambda _: by_pillow("JPEG", progressive=True),
    "photo.png": lambda _: by_pillow("PNG"),
    "deep.png": by_oiio("a.png", "uint16"),
    "photo.tif": lambda _: by_pillow("TIFF", compression="tiff_lzw"),
    "float.tif": by_oiio("a.tif", "float", compression="zip"),
    "photo.exr": by_oiio("a.exr", "half", compression="zip"),
    "piz.exr": by_oiio("b.exr", "float", compression="piz"),
    "tiles.exr": by_oiio("c.exr", "half", tile=16, compression="zip"),
    "photo.hdr": by_oiio("a.hdr", "float"),
    "photo.heic": heif,
    "photo.dng": lambda _: by_pillow("TIFF", tiffinfo={50706: b"\1\4\0\0", 262: 32803}),
}


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


# ── what is spoiled, and who reads it ────────────────────────────────────────────────────────────────────────────────


def spoiled_mesh(name: str) -> st.SearchStrategy:
    if name.startswith("b."):
        return spoiled_bytes(MESHES[name])
    if name in ("a.gltf", "a.glb"):
        header = spoiled(json.loads(gltf_text())).map(json.dumps)
        return header.map(glb if name == "a.glb" else str.encode) | spoiled_bytes(MESHES[name])
    return spoiled_words(MESHES[name]) | spoiled_bytes(MESHES[name])


HEADER, PALETTE = png_header(W, H, kind=3), bytes(range(9))
A_PNG = st.builds(
    png,
    spoiled_bytes(HEADER) | st.just(HEADER),
    spoiled_bytes(PIXELS) | st.just(PIXELS),
    spoiled_bytes(PALETTE) | st.just(PALETTE),
)
KINDS = st.tuples(
    st.sampled_from([1, 2, 4, 8, 16]), st.sampled_from([0, 2, 3, 4, 6]), st.binary(min_size=50, max_size=800)
)
ANY_PNG = KINDS.map(lambda kind: png(png_header(W, H, *kind[:2]), zlib.compress(kind[2] * 4), PALETTE))
A_DATASET = st.sampled_from([{}, *({"cameras": source} for source in SOURCES.values())]).flatmap(
    lambda c: spoiled(DATASET | c)
)


def plain(name: str) -> st.SearchStrategy:
    return spoiled(PLAIN[name]).map(text_of) | spoiled_bytes(text_of(PLAIN[name]))


PARTS = {  # name -> (file, its contents, who reads it); None: the good file's bytes spoiled
    "dataset.yaml": ("dataset.yaml", A_DATASET.map(yaml_of), "set"),
    "text of dataset.yaml": ("dataset.yaml", spoiled_bytes(yaml_of(DATASET)), "set"),
    "truth.yaml": ("truth.yaml", spoiled(PLAIN["truth.yaml"]).map(yaml_of), "set"),
    "PNG": ("mask.png", A_PNG | ANY_PNG, "mask"),
    "COCO": ("coco.json", spoiled(COCO).map(text_of) | spoiled_bytes(text_of(COCO)), "mask"),
    "COLMAP cameras": ("model/cameras.bin", spoiled_bytes(cameras_bin()), "colmap"),
    "COLMAP images": ("model/images.bin", spoiled_bytes(images_bin()), "colmap"),
    "COLMAP cameras as text": ("text/cameras.txt", spoiled_bytes(CAMERAS_TXT), "colmap text"),
    "COLMAP images as text": ("text/images.txt", spoiled_bytes(IMAGES_TXT), "colmap text"),
    "transforms.json": ("t.json", spoiled(TRANSFORMS).map(text_of) | spoiled_bytes(text_of(TRANSFORMS)), "transforms"),
    "BOP cameras": ("model/scene_camera.json", plain("model/scene_camera.json"), "bop"),
    "BOP poses": ("model/scene_gt.json", plain("model/scene_gt.json"), "bop"),
    "observations": ("observations.parquet", None, "observations"),
    "lobes": ("solve/lobes.parquet", None, "lobes"),
    "true light": ("light.exr", None, "true light"),
    "earlier solution": ("solve/materials.json", plain("solve/materials.json"), "solution"),
    "earlier exposures": ("solve/exposures.json", plain("solve/exposures.json"), "solution"),
    "earlier poses": ("poses.json", plain("poses.json"), "poses"),
    **{name: (name, spoiled_mesh(name), read_usable_mesh) for name in MESHES},
    **{name: (name, None, read_picture) for name in PICTURES},
}
QUICK = {name for name in PARTS if name not in PICTURES or name in ("photo.jpg", "photo.exr")}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = make_set(tmp_path_factory.mktemp("fuzz") / "set")
    os.mkfifo(folder / "pipe.png")
    (folder / "link.png").symlink_to("/etc/passwd")
    (folder / "x").symlink_to("x")
    for name, make in PICTURES.items():
        (folder / name).write_bytes(make(folder))
    assert LABEL.shape == (H, W)
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


def came_of(read, folder, file: str) -> str:
    """Whether the file is read or refused; the only exception that may come out is InputError, and no raw warning."""
    began, refused = time.process_time(), None
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            read(folder, file)
        except InputError as error:
            refused = error
    assert refused is None or (refused.file and refused.found and refused.cure and len(str(refused)) < 3000)
    assert time.process_time() - began < MOST_SECONDS
    return "refused" if refused else "accepted"


def fuzz(folder, part: str, **options) -> None:
    file, contents, reader = PARTS[part]
    read, came = READERS.get(reader, reader), Counter()
    came_of(read, folder, file)
    contents = spoiled_bytes((folder / file).read_bytes()) if contents is None else contents

    @settings(deadline=None, database=None, suppress_health_check=list(HealthCheck), print_blob=False, **options)
    @given(contents)
    def spoil(content):
        with changed(folder, file, content):
            came[came_of(read, folder, file)] += 1

    if not options.get("derandomize"):
        seed(time.time_ns())(spoil)
    spoil()
    note("fuzz", part, came.total(), **came)


@pytest.mark.parametrize(
    "part", [part if part in QUICK else pytest.param(part, marks=pytest.mark.long) for part in PARTS]
)
def test_a_spoiled_file_is_read_or_refused(folder, part):
    fuzz(folder, part, max_examples=FEW, derandomize=True, phases=(Phase.generate,))


@pytest.mark.long
@pytest.mark.parametrize("part", PARTS)
def test_thousands_of_spoiled_files_are_read_or_refused(folder, part):
    end = time.monotonic() + LONG / len(PARTS)
    while time.monotonic() < end:
        fuzz(folder, part, max_examples=MANY)
