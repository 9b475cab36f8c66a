"""COCO annotations as masks: polygons, and RLE as counts or compressed, by category and file name.

Polygons are filled by pycocotools, which takes memory for every pixel of an outline: how long one may be is checked first.
RLE is decoded by `rle`.  The shapes of other photos in the file are left as text.
"""

from __future__ import annotations

import math
from pathlib import Path, PurePosixPath

import msgspec
import numpy as np
from jaxtyping import Bool, Float
from pycocotools import mask as pycocomask

from factorlib.errors import InputError, did_you_mean
from factorlib.labels.rle import Union
from factorlib.reading import read_bytes, reading

OVERSHOOT = 2.0  # pixels by which a polygon may leave the image
MOST_BYTES = 512_000_000  # of a file; a hundred thousand outlines have half of it
LONGEST, LONGEST_OF_ALL = 200, 5000  # an outline, and all of a photo together, in half perimeters of the photo
CURE = "export the file again"


class Rle(msgspec.Struct, frozen=True):
    """Lengths of runs of outside, inside, outside, … down the columns; a string is COCO's compressed form of it."""

    size: tuple[int, int]  # height, width
    counts: list[int] | str


class Annotation(msgspec.Struct, frozen=True):
    """The shape of one object in one image; segmentation: polygons or RLE, left as JSON text until its photo is read."""

    image_id: int | str
    category_id: int | str
    segmentation: msgspec.Raw = msgspec.Raw(b"null")
    id: int | str | None = None


class Category(msgspec.Struct, frozen=True):
    """What an annotation shows: the name is a material's."""

    id: int | str
    name: str


class CocoImage(msgspec.Struct, frozen=True):
    """An image that annotations are about; width, height: in pixels, None where the file does not say."""

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
    if shape != size:
        return {}, shape
    names = {category.id: category.name for category in coco.categories}
    of_material: dict[str, list[tuple[str, Annotation]]] = {}
    for index, annotation in enumerate(coco.annotations):
        if annotation.image_id == entry.id:
            name = _material(annotation, names, materials, path, f"annotations[{index}]")
            of_material.setdefault(name, []).append((f"annotations[{index}].segmentation", annotation))
    masks: dict[str, np.ndarray] = {}
    length = 0.0
    for name, parts in of_material.items():
        masks[name], length = _union(parts, shape, length, path)
    return masks, shape


def _union(
    parts: list[tuple[str, Annotation]], shape: tuple[int, int], length: float, path: str | Path
) -> tuple[Bool[np.ndarray, "h w"], float]:
    """Of the annotations of one material; length: of all outlines of the photo so far, pixels, before and after."""
    union = Union(*shape)
    for key, annotation in parts:
        counts, longer = _counts(annotation.segmentation, shape, path, key)
        length += longer
        if length > LONGEST_OF_ALL * sum(shape):
            raise InputError("the outlines of this photo are longer than any drawing", file=path, key=key, cure=CURE)
        for each in counts:
            with reading("RLE", path, key, CURE):
                union.add(each)
    return union.mask(), length


def _decode(path: str | Path, key: str) -> Coco:
    content = read_bytes(path, "COCO", key, MOST_BYTES)
    with reading("COCO", path, key, "it needs images, annotations and categories"):
        return msgspec.json.decode(content, type=Coco)


def _entry(coco: Coco, image: str, path: str | Path) -> CocoImage:
    """The image entry of the same path, or else of the same file name."""
    same = [e for e in coco.images if PurePosixPath(e.file_name) == PurePosixPath(image)]
    base = PurePosixPath(image).name
    found = same or [e for e in coco.images if _base(e.file_name) == base]
    if not found:
        cure = did_you_mean(base, [_base(e.file_name) for e in coco.images])
        raise InputError(f"has no image {base!r}", file=path, key="images", cure=cure)
    if len(found) > 1:
        raise InputError(
            f"has {len(found)} images {base!r}", file=path, key="images", cure=f"keep one, or name it {image!r} in full"
        )
    return found[0]


def _base(file_name: str) -> str:
    return PurePosixPath(file_name.replace("\\", "/")).name


def _material(annotation: Annotation, names: dict, materials: list[str], path: str | Path, key: str) -> str:
    name = names.get(annotation.category_id)
    if name is None:
        fault = f"category_id {annotation.category_id!r} is not in categories"
        raise InputError(fault, file=path, key=key, cure="export the file again")
    if name not in materials:
        cure = did_you_mean(name, materials) + " (categories are the dataset's materials)"
        raise InputError(f"category {name!r} is no material", file=path, key=key, cure=cure)
    return name


def _counts(text: msgspec.Raw, shape: tuple[int, int], path: str | Path, key: str) -> tuple[list, float]:
    """Run lengths of the parts of a shape, and how long its outlines are."""
    with reading("a COCO segmentation", path, key, CURE):
        segmentation = msgspec.json.decode(text, type=list[list[float]] | Rle | None)
    if not segmentation:
        raise InputError(
            "is empty: the annotation has only a box", file=path, key=key, cure="draw its outline, or delete it"
        )
    if not isinstance(segmentation, Rle):
        return _filled(segmentation, shape, path, key)
    if tuple(segmentation.size) != shape:
        found = f"its RLE is {_wh(segmentation.size)} pixels, the image {_wh(shape)}"
        raise InputError(found, file=path, key=key, cure="export it at the photo's own size")
    return [segmentation.counts], 0.0


def _filled(polygons: list[list[float]], shape: tuple[int, int], path: str | Path, key: str) -> tuple[list[str], float]:
    height, width = shape
    clipped, length = [], 0.0
    for index, polygon in enumerate(polygons):
        corners = _corners(polygon, shape, path, f"{key}[{index}]")
        longer = float(np.abs(np.diff(corners, axis=0, append=corners[:1])).max(axis=1).sum())
        if longer > LONGEST * (height + width):
            fault = f"its outline is {longer:.3g} pixels long"
            raise InputError(fault, file=path, key=f"{key}[{index}]", cure="draw it again, with fewer corners")
        clipped.append(corners.ravel().tolist())
        length += longer
    return [each["counts"].decode("ascii") for each in pycocomask.frPyObjects(clipped, height, width)], length


def _corners(polygon: list[float], shape: tuple[int, int], path: str | Path, key: str) -> Float[np.ndarray, "n 2"]:
    """x, y of each corner, cut at the edge of the image."""
    height, width = shape
    if len(polygon) < 6 or len(polygon) % 2 or not all(map(math.isfinite, polygon)):
        found, cure = "is no polygon", "a polygon is [x1, y1, x2, y2, x3, y3, …], three corners or more"
        raise InputError(found, file=path, key=key, cure=cure)
    corners = np.reshape(polygon, (-1, 2))
    if (corners < -OVERSHOOT).any() or (corners > np.array([width, height]) + OVERSHOOT).any():
        found, cure = (
            f"leaves the image of {_wh(shape)} pixels",
            "was it drawn at another size? cut it at the image's edge",
        )
        raise InputError(found, file=path, key=key, cure=cure)
    return np.clip(corners, 0, [width, height])


def _wh(shape: tuple[int, int]) -> str:
    return f"{shape[1]} × {shape[0]}"
