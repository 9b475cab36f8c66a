"""Masks and photos that would hang the reader or fill memory are refused, by their headers where they have one."""

import json
import struct
import time
import zlib
from contextlib import contextmanager

import msgspec
import numpy as np
import pytest
from PIL import Image

from factorlib.dataset.schema import ObjectMask, PhotoSlice
from factorlib.errors import InputError
from factorlib.labels import read_labels
from factorlib.labels.coco import read_coco
from factorlib.labels.rle import decode_rle, decompress
from factorlib.stage import Inputs
from stages import masks

MATERIALS = ["red", "white"]
H, W = 40, 60


@contextmanager
def in_a_moment(seconds=10.0):
    begin = time.process_time()
    yield
    assert time.process_time() - begin < seconds


def png_header(path, width, height, bits=8, kind=0):
    """A PNG that ends after its header: whoever looks at its pixels finds none."""
    head = struct.pack(">IIBBBBB", width, height, bits, kind, 0, 0, 0)
    chunk = struct.pack(">I", len(head)) + b"IHDR" + head + struct.pack(">I", zlib.crc32(b"IHDR" + head))
    start = struct.pack(">I", 100) + b"IDAT"
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + chunk + start)
    with path.open("r+b") as stream:
        stream.truncate(20_000_000)  # OpenImageIO believes no large picture in a small file
    return path


# ── headers ──────────────────────────────────────────────────────────────────────────────────────────────────────────


def refusal(folder, params=None, **facts):
    photo = PhotoSlice(**{"image": "photo.png", "encoding": None, "masks": "mask.png", "focal_px": None, "illumination": "a", "objects": []} | facts)
    inputs = Inputs(
        folders={},
        facts={"dataset.photo": msgspec.to_builtins(photo), "dataset.materials": MATERIALS},
        files={path.name: path for path in folder.iterdir()},
        photo="hall",
    )
    with in_a_moment(), pytest.raises(InputError) as caught:
        masks.main(params or masks.Params(), inputs, folder)
    assert caught.value.cure and caught.value.file
    return caught.value


@pytest.fixture
def folder(tmp_path):
    Image.fromarray(np.zeros((H, W, 3), np.uint8)).save(tmp_path / "photo.png")
    Image.fromarray(np.ones((H, W), np.uint8)).save(tmp_path / "mask.png")
    return tmp_path


def test_a_photo_of_a_gigapixel_is_refused_by_its_header(folder):
    png_header(folder / "photo.png", 30_000, 30_000, kind=2)
    png_header(folder / "mask.png", 30_000, 30_000)
    error = refusal(folder)
    assert "900 megapixels; at most 200" in error.found and error.key == "photos[hall].image" and "most_megapixels=900" in error.cure


def test_the_limit_of_a_photo_is_a_parameter(folder):
    error = refusal(folder, masks.Params(most_megapixels=0.001))
    assert "0.0024 megapixels; at most 0.001" in error.found


@pytest.mark.parametrize("given", ["mask.png", {"red": "mask.png"}])
def test_a_mask_of_another_size_is_refused_by_its_header(folder, given):
    png_header(folder / "photo.png", 10_000, 10_000, kind=2)  # nor are the photo's pixels looked at
    png_header(folder / "mask.png", 30_000, 30_000)
    assert "the mask is 30000 × 30000 pixels, the photo 10000 × 10000" in refusal(folder, masks=given).found


def test_an_objects_mask_of_another_size_is_refused_by_its_header(folder):
    png_header(folder / "own.png", 30_000, 30_000)
    assert "the mask is 30000 × 30000 pixels" in refusal(folder, objects=[ObjectMask("vase", "own.png")]).found


def test_a_mask_as_large_as_a_large_photo_is_no_bomb(tmp_path, recwarn):
    """Pillow's own limit warns, with a line of its source, at 89 megapixels, and refuses at 179."""
    bits = zlib.compressobj(1)
    rows = b"".join(bits.compress(b"\x00" + b"\xff" * 1750) for _ in range(14_000)) + bits.flush()
    head = struct.pack(">IIBBBBB", 14_000, 14_000, 1, 0, 0, 0, 0)
    chunks = ((b"IHDR", head), (b"IDAT", rows), (b"IEND", b""))
    content = b"".join(struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data)) for name, data in chunks)
    (tmp_path / "mask.png").write_bytes(b"\x89PNG\r\n\x1a\n" + content)
    with pytest.raises(InputError, match="the mask is 14000 × 14000"):
        read_labels("mask.png", lambda name: tmp_path / name, MATERIALS, (10, 10), "photo.png")
    assert not recwarn.list


@pytest.mark.parametrize("content", [b"", b"\x89PNG\r\n\x1a\n", b"GIF89a", b"\x89PNG\r\n\x1a\n" + b"\x00" * 100])
def test_a_mask_that_is_no_png(folder, content):
    (folder / "mask.png").write_bytes(content)
    assert "not readable as a PNG" in refusal(folder).found


def test_text_that_unpacks_without_end_in_a_mask(folder):
    """A chunk of compressed text: 200 MB of it in 200 kB."""
    text = b"a\x00\x00" + zlib.compress(b"\x00" * 200_000_000)
    chunk = struct.pack(">I", len(text)) + b"zTXt" + text + struct.pack(">I", zlib.crc32(b"zTXt" + text))
    content = (folder / "mask.png").read_bytes()
    (folder / "mask.png").write_bytes(content[:33] + chunk + content[33:])
    assert "not readable as a PNG" in refusal(folder).found


# ── COCO ─────────────────────────────────────────────────────────────────────────────────────────────────────────────


def coco(folder, *segmentations, image=None, **others):
    content = {
        "images": [{"id": 7, "file_name": "photo.png", **(image or {})}],
        "categories": [{"id": 1, "name": "red"}],
        "annotations": [{"image_id": 7, "category_id": 1, "segmentation": each} for each in segmentations],
    }
    (folder / "coco.json").write_text(json.dumps(content | others))
    return read_coco(folder / "coco.json", "photo.png", MATERIALS, (H, W))


def refused_coco(folder, *segmentations, **others):
    with in_a_moment(), pytest.raises(InputError) as caught:
        coco(folder, *segmentations, **others)
    assert caught.value.cure and caught.value.file and len(str(caught.value)) < 1000
    return caught.value


@pytest.mark.parametrize("text", ["o" * 2_000_000, "_" * 2_000_000 + "0", "P" * 50 + "0", "0" * 2_000_000 + "o", "~", "é", ""])
def test_compressed_run_lengths_without_end(text):
    with in_a_moment(), pytest.raises(ValueError):
        decode_rle(text, H, W)


def test_compressed_run_lengths_of_millions_are_read_in_their_own_time():
    with in_a_moment():
        assert len(decompress("10" * 500_000)) == 1_000_000


@pytest.mark.parametrize(
    "rle",
    [
        {"size": [H, W], "counts": [10**30]},
        {"size": [H, W], "counts": [-5, 5, H * W]},
        {"size": [H, W], "counts": []},
        {"size": [10**9, 10**9], "counts": [10**18]},
        {"size": [H, W], "counts": "o" * 100_000},
        {"size": [-1, -1], "counts": [1]},
        {"size": [H, W], "counts": 5},
        {"size": [H, W]},
        {"size": "x", "counts": [1]},
        "x",
        5,
        [],
        [[]],
        [[1, 2, 3]],
        [["a"] * 6],
        [[0, 0, 1e300, 0, 0, 1]],
        [[0, 0, 70, 0, 0, 1]],
    ],
)
def test_a_shape_that_is_none(tmp_path, rle):
    assert refused_coco(tmp_path, rle).key.startswith("annotations[0]")


def test_an_outline_longer_than_any_drawing(tmp_path):
    """pycocotools takes memory for each of its pixels: half a gigabyte here."""
    zigzag = [coordinate for k in range(100_000) for coordinate in ((0, 0) if k % 2 else (W, H))]
    assert "pixels long" in refused_coco(tmp_path, [zigzag]).found


def test_outlines_that_are_longer_together(tmp_path):
    square = [0, 0, W, 0, W, H, 0, H]
    assert "longer than any drawing" in refused_coco(tmp_path, *[[square] * 100] * 100).found


def test_thousands_of_shapes_of_one_material_cost_one_picture(tmp_path):
    dots = [{"size": [H, W], "counts": [k, 1, H * W - k - 1]} for k in range(0, H * W, 2)] * 10
    with in_a_moment():
        inside = coco(tmp_path, *dots, [[2, 2, 8, 2, 8, 8, 2, 8]])[0]["red"]
    assert inside.T.ravel()[::2].all() and not inside[30:].T.ravel()[1::2].any() and inside[3, 3]


def test_shapes_of_other_photos_are_not_looked_at(tmp_path):
    good, other = [[2, 2, 8, 2, 8, 8]], {"image_id": 8, "category_id": 1, "segmentation": {"size": [1, 1], "counts": "o" * 1000}}
    annotations = [{"image_id": 7, "category_id": 1, "segmentation": good}, other]
    assert coco(tmp_path, annotations=annotations)[0]["red"].any()


@pytest.mark.parametrize("image", [{"width": 10**12, "height": 10**12}, {"width": -5, "height": -5}, {"width": 10**15}])
def test_an_image_of_coco_of_another_size_is_not_made(tmp_path, image):
    with in_a_moment():
        assert coco(tmp_path, [[2, 2, 8, 2, 8, 8]], image=image)[1] != (H, W)  # which read_labels refuses


@pytest.mark.parametrize("image", [{"file_name": 5}, {"id": None}, {"file_name": "a\0b"}, {"width": "wide"}])
def test_an_image_of_coco_that_is_none(tmp_path, image):
    refused_coco(tmp_path, [[2, 2, 8, 2, 8, 8]], image=image)


@pytest.mark.parametrize("content", ["[" * 100_000, '{"images": ' + "[" * 100_000, "", "null", "\x00", '{"images": 5}'], ids=range(6))
def test_a_json_that_is_no_coco(tmp_path, content):
    (tmp_path / "coco.json").write_text(content)
    with in_a_moment(), pytest.raises(InputError, match="not readable as COCO"):
        read_coco(tmp_path / "coco.json", "photo.png", MATERIALS, (H, W))


def test_a_photo_among_a_hundred_thousand_names_is_missed_in_a_moment(tmp_path):
    images = [{"id": k, "file_name": f"IMG_{k:06}.jpg"} for k in range(100_000)]
    assert len(str(refused_coco(tmp_path, images=images))) < 1000
