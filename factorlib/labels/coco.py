"""COCO annotations as masks: polygons, and RLE as counts or compressed, by category and file name.

Polygons are filled by pycocotools.  RLE is decoded here, and checked first: its counts must fill the image exactly.
"""

from __future__ import annotations

import math
from itertools import accumulate
from pathlib import Path, PurePosixPath
from typing import Any

import msgspec
import numpy as np
from jaxtyping import Bool
from pycocotools import mask as pycocomask

from factorlib.errors import InputError, did_you_mean

OVERSHOOT = 2.0  # pixels by which a polygon may leave the image


class Rle(msgspec.Struct, frozen=True):
    """Lengths of runs of outside, inside, outside, … down the columns; a string is COCO's compressed form of it."""

    size: tuple[int, int]  # height, width
    counts: list[int] | str


class Annotation(msgspec.Struct, frozen=True):
    image_id: int | str
    category_id: int | str
    segmentation: list[list[float]] | Rle | None = None
    id: int | str | None = None


class Category(msgspec.Struct, frozen=True):
    id: int | str
    name: str


class CocoImage(msgspec.Struct, frozen=True):
    id: int | str
    file_name: str
    width: int | None = None
    height: int | None = None


class Coco(msgspec.Struct, frozen=True):
    """The part of a COCO file that is read; what else stands in it is left alone."""

    images: list[CocoImage]
    annotations: list[Annotation]
    categories: list[Category]


def read_coco(
    path: str | Path, image: str, materials: list[str], size: tuple[int, int], key: str = "masks"
) -> tuple[dict[str, Bool[np.ndarray, "h w"]], tuple[int, int]]:
    """The union of the annotations of each material in the photo named `image`, and the (height, width) they are for.

    size: (height, width) of the photo, for files that do not say it; key: where the file is named, for messages.
    """
    coco = _decode(path, key)
    entry = _entry(coco, image, path)
    shape = (entry.height or size[0], entry.width or size[1])
    names = {category.id: category.name for category in coco.categories}
    masks: dict[str, np.ndarray] = {}
    if shape != size:
        return masks, shape
    for index, annotation in enumerate(coco.annotations):
        if annotation.image_id != entry.id:
            continue
        key = f"annotations[{index}]"
        name = _material(annotation, names, materials, path, key)
        inside = _inside(annotation.segmentation, shape, path, f"{key}.segmentation")
        masks[name] = masks[name] | inside if name in masks else inside
    return masks, shape


def decode_rle(counts: list[int] | str, height: int, width: int) -> Bool[np.ndarray, "height width"]:
    """The mask of run lengths, column by column; raises ValueError unless they fill it exactly.

    >>> decode_rle([1, 2, 1], 2, 2).astype(int).tolist()
    [[0, 1], [1, 0]]
    """
    runs = decompress(counts) if isinstance(counts, str) else counts
    if min(runs, default=0) < 0 or sum(runs) != height * width:
        raise ValueError(f"its runs fill {sum(runs)} of {height * width} pixels")
    inside = np.repeat(np.arange(len(runs)) % 2 == 1, runs)
    return np.ascontiguousarray(inside.reshape(width, height).T)


def decompress(text: str) -> list[int]:
    """Run lengths of COCO's string: 5 bits a character (+48), the sixth says "more follows", the sign in the last;
    from the third run on each is the difference to the run two before.  Raises ValueError."""
    values, value, shift = [], 0, 0
    for character in text:
        bits = ord(character) - 48
        if not 0 <= bits < 64:
            raise ValueError(f"{character!r} is no character of a compressed RLE")
        value |= (bits & 31) << shift
        shift += 5
        if not bits & 32:
            values.append(value - (1 << shift) if bits & 16 else value)
            value, shift = 0, 0
    if shift:
        raise ValueError("its compressed RLE ends in the middle of a number")
    return values[:1] + _undifferenced(values[1::2], values[2::2])


def _undifferenced(odd: list[int], even: list[int]) -> list[int]:
    runs = [0] * (len(odd) + len(even))
    runs[0::2], runs[1::2] = accumulate(odd), accumulate(even)
    return runs


def _decode(path: str | Path, key: str) -> Coco:
    try:
        return msgspec.json.decode(Path(path).read_bytes(), type=Coco)
    except (OSError, msgspec.MsgspecError, UnicodeDecodeError) as error:
        cure = "it needs images, annotations and categories"
        raise InputError(f"not readable as COCO ({error})", file=path, key=key, cure=cure) from error


def _entry(coco: Coco, image: str, path: str | Path) -> CocoImage:
    """The image entry of the same path, or else of the same file name."""
    same = [e for e in coco.images if PurePosixPath(e.file_name) == PurePosixPath(image)]
    base = PurePosixPath(image).name
    found = same or [e for e in coco.images if _base(e.file_name) == base]
    if not found:
        cure = did_you_mean(base, [_base(e.file_name) for e in coco.images])
        raise InputError(f"has no image {base!r}", file=path, key="images", cure=cure)
    if len(found) > 1:
        raise InputError(f"has {len(found)} images {base!r}", file=path, key="images", cure=f"keep one, or name it {image!r} in full")
    return found[0]


def _base(file_name: str) -> str:
    return PurePosixPath(file_name.replace("\\", "/")).name


def _material(annotation: Annotation, names: dict, materials: list[str], path: str | Path, key: str) -> str:
    name = names.get(annotation.category_id)
    if name is None:
        raise InputError(f"category_id {annotation.category_id!r} is not in categories", file=path, key=key, cure="export the file again")
    if name not in materials:
        cure = did_you_mean(name, materials) + " (categories are the dataset's materials)"
        raise InputError(f"category {name!r} is no material", file=path, key=key, cure=cure)
    return name


def _inside(segmentation: Any, shape: tuple[int, int], path: str | Path, key: str) -> np.ndarray:
    if not segmentation:
        raise InputError("is empty: the annotation has only a box", file=path, key=key, cure="draw its outline, or delete it")
    if not isinstance(segmentation, Rle):
        return _filled(segmentation, shape, path, key)
    if tuple(segmentation.size) != shape:
        found = f"its RLE is {_wh(segmentation.size)} pixels, the image {_wh(shape)}"
        raise InputError(found, file=path, key=key, cure="export it at the photo's own size")
    try:
        return decode_rle(segmentation.counts, *shape)
    except ValueError as error:
        raise InputError(f"damaged RLE: {error}", file=path, key=key, cure="export the file again") from error


def _filled(polygons: list[list[float]], shape: tuple[int, int], path: str | Path, key: str) -> np.ndarray:
    height, width = shape
    clipped = []
    for index, polygon in enumerate(polygons):
        if len(polygon) < 6 or len(polygon) % 2 or not all(map(math.isfinite, polygon)):
            found, cure = "is no polygon", "a polygon is [x1, y1, x2, y2, x3, y3, …], three corners or more"
            raise InputError(found, file=path, key=f"{key}[{index}]", cure=cure)
        corners = np.reshape(polygon, (-1, 2))
        if (corners < -OVERSHOOT).any() or (corners > np.array([width, height]) + OVERSHOOT).any():
            found, cure = f"leaves the image of {_wh(shape)} pixels", "was it drawn at another size? cut it at the image's edge"
            raise InputError(found, file=path, key=f"{key}[{index}]", cure=cure)
        clipped.append(np.clip(corners, 0, [width, height]).ravel().tolist())
    union = pycocomask.merge(pycocomask.frPyObjects(clipped, height, width))
    return decode_rle(union["counts"].decode("ascii"), height, width)


def _wh(shape: tuple[int, int]) -> str:
    return f"{shape[1]} × {shape[0]}"
