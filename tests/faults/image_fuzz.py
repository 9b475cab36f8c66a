"""Images spoiled at random, read in a process of their own, which a library may crash: `image_fuzz.py FOLDER KIND SEED COUNT`.

Prints what became of them, as JSON: {"tries", "accepted", "refused", "other": [what else came out]}.
"""

from __future__ import annotations

import io
import json
import logging
import resource
import sys
import time
import warnings
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
from PIL import Image

from factorlib.errors import InputError
from factorlib.evaluate.truth import read_true_light
from factorlib.images.header import check_values
from factorlib.images.limits import check_pixels
from factorlib.images.photo import decoded, open_photo
from factorlib.labels.png import read_values

W, H = 40, 30
MEMORY = 12 << 30  # of addresses, libraries included
MOST_SECONDS = 20.0
PIXELS = np.random.default_rng(0).random((H, W, 3), dtype=np.float32)
NUMBERS = (b"\xff\xff\xff\xff", b"\0\0\0\0", b"\x7f\xff\xff\xff", b"\xff\xff\xff\x7f", b"\0\0\0\x80", b"\xff\xff", b"\xff", b"\0", b"\x80")


def by_oiio(name: str, kind: str, tile: int = 0, **attributes: str) -> bytes:
    """A picture as OpenImageIO writes it."""
    path = Path(sys.argv[1]) / f"good-{name}"
    spec = oiio.ImageSpec(W, H, 3, kind)
    spec.tile_width = spec.tile_height = tile
    for key, value in attributes.items():
        spec.attribute(key, value)
    output = oiio.ImageOutput.create(str(path))
    assert output.open(str(path), spec)
    assert output.write_image(PIXELS) if not tile else output.write_tiles(0, W, 0, H, 0, 1, PIXELS)
    output.close()
    del output
    return path.read_bytes()


def by_pillow(kind: str, **options: object) -> bytes:
    """A picture as Pillow writes it, with notes of a camera."""
    stream, exif = io.BytesIO(), Image.Exif()
    exif[0x0112], exif[0x010F] = 6, "maker"
    exif.get_ifd(0x8769)[0x920A] = 50.0
    Image.fromarray((255 * PIXELS).astype(np.uint8)).save(stream, kind, exif=exif, **options)
    return stream.getvalue()


def heif() -> bytes:
    import pillow_heif

    pillow_heif.register_heif_opener()
    return by_pillow("HEIF")


def grey() -> bytes:
    stream = io.BytesIO()
    Image.fromarray(np.eye(H, W, dtype=np.uint8)).save(stream, "PNG")
    return stream.getvalue()


KINDS = {
    "photo.jpg": lambda: by_pillow("JPEG", quality=80),
    "progressive.jpg": lambda: by_pillow("JPEG", progressive=True),
    "photo.png": lambda: by_pillow("PNG"),
    "deep.png": lambda: by_oiio("a.png", "uint16"),
    "photo.tif": lambda: by_pillow("TIFF", compression="tiff_lzw"),
    "float.tif": lambda: by_oiio("a.tif", "float", compression="zip"),
    "photo.exr": lambda: by_oiio("a.exr", "half", compression="zip"),
    "piz.exr": lambda: by_oiio("b.exr", "float", compression="piz"),
    "tiles.exr": lambda: by_oiio("c.exr", "half", tile=16, compression="zip"),
    "photo.hdr": lambda: by_oiio("a.hdr", "float"),
    "photo.heic": heif,
    "mask.png": grey,
    "true light.exr": lambda: by_oiio("d.exr", "float", compression="zip"),
    "photo.dng": lambda: by_pillow("TIFF", tiffinfo={50706: b"\1\4\0\0", 262: 32803}),
}


def spoil(content: bytes, chance: np.random.Generator) -> bytes:
    """Bytes changed, cut out, doubled or put in, mostly where headers are; cut at the end at times."""
    for _ in range(chance.integers(1, 5)):
        reach = len(content) if chance.random() < 0.5 else min(len(content), 400)
        at, length = int(chance.integers(0, reach + 1)), int(chance.choice([0, 1, 1, 2, 4, 4, 8, 40]))
        new = [chance.bytes(int(chance.integers(0, 7))), NUMBERS[chance.integers(len(NUMBERS))], content[at : at + 60]][chance.integers(3)]
        content = content[:at] + new + content[at + (length if chance.random() < 0.5 else len(new)) :]
    return content[: int(chance.integers(0, len(content) + 1))] if chance.random() < 0.1 else content


def read(path: Path, kind: str) -> None:
    """As validation and the stages do: the header, the limits, then the pixels."""
    if kind == "mask.png":
        read_values(path, "masks", (H, W))
        return
    if kind == "true light.exr":
        check_values(path, 2.0)
        read_true_light(path, "a")
        return
    stored = open_photo(path, "image")
    check_pixels(stored.size, 2.0, path, "image")
    check_values(path, 2.0, "image")
    found = decoded(stored, None, 1, path)
    assert np.isfinite(found.radiance).all() and found.radiance.shape == (found.height, found.width, 3)


def main(folder: Path, kind: str, seed: int, count: int) -> None:
    """Spoil and read `count` files."""
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    logging.disable(logging.CRITICAL)
    chance, good, came = np.random.default_rng(seed), KINDS[kind](), {"tries": 0, "accepted": 0, "refused": 0, "other": []}
    for number in range(count):
        path = folder / f"{seed}-{kind}"
        path.write_bytes(spoil(good, chance) if number else good)
        begin, came["tries"] = time.process_time(), came["tries"] + 1
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                read(path, kind)
            came["accepted"] += 1
        except InputError as error:
            came["refused"] += 1
            if not (error.cure and error.file and len(str(error)) < 3000):
                came["other"].append(f"{seed}/{number}: says too little or too much: {error!r}")
        except BaseException as error:
            came["other"].append(f"{seed}/{number}: {type(error).__name__}: {error}"[:300])
        if time.process_time() - begin > MOST_SECONDS:
            came["other"].append(f"{seed}/{number}: took {time.process_time() - begin:.0f} s")
    print(json.dumps(came))


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2], int(sys.argv[3]), int(sys.argv[4]))
