"""Readers of mask files: PNG of one channel, and COCO annotations.

Pillow reads PNG, because it alone keeps the stored values: palette indices, not the palette's colours. It stretches
grey of 2 or 4 bits to 8 bits, which is undone.

COCO masks are polygons, and RLE as counts or compressed, by category and file name. pycocotools fills the polygons. It
needs memory for every pixel of an outline, so the length of outlines is checked first. Run lengths are decoded here:
pycocotools makes a mask of random memory of runs that are cut short. Several shapes give their union, at the cost of
the number of runs and one picture. The shapes of other photos in the file are left as text.
"""

from collections.abc import Sequence
from pathlib import Path, PurePosixPath

import msgspec
import numpy as np
from jaxtyping import Bool, Int, UInt16
from PIL import Image
from pycocotools import mask as pycocomask

from factorlib.errors import InputError, did_you_mean
from factorlib.reading import check_plain, read_bytes, reading

_STRETCH = {2: 85, 4: 17}  # code of 1 after grey of so many bits is stretched to 8
_GREY = 0  # PNG colour types
_PALETTE = 3
Image.MAX_IMAGE_PIXELS = None  # Pillow warns at 89 megapixels; a mask has the size of its photo, which is limited
OVERSHOOT = 2.0  # a polygon may leave the image by this many pixels
MOST_BYTES = 512_000_000  # greatest size of a file; a hundred thousand outlines take half of it
LONGEST = 200  # greatest length of an outline, in half perimeters of the photo
LONGEST_TOGETHER = 5000  # greatest length of all outlines of a photo together
MOST_DIGITS = 7  # greatest number of 5-bit digits of a compressed run length: no picture has 2**35 pixels
CURE = "export the file again"
SIMPLER = "draw outlines with fewer corners, or export the file again"


def read_values(path: str | Path, key: str, size: tuple[int, int] | None = None) -> UInt16[np.ndarray, "h w"]:
    """Read the stored values of a PNG.

    RGB is accepted only if R = G = B, alpha only if it is opaque.

    Args:
        path: File.
        key: Key to name in errors.
        size: Expected height and width, checked by the header.

    Returns:
        Values.

    Raises:
        InputError: If the file is not such a PNG, or has another size.
    """
    check_plain(path, "a PNG", key)
    with reading("a PNG", path, key, "save the mask again, as PNG"), Image.open(path, formats=["PNG"]) as image:
        check_size(image.size[::-1], size or image.size[::-1], path, key)
        values = np.asarray(image)
    with Path(path).open(
        "rb"
    ) as stream:  # bit depth and colour type, after signature, IHDR's length and name, and size
        depth, colour_type = stream.read(26)[24:26]
    fault = None
    if depth == 16 and colour_type not in (_GREY, _PALETTE):  # Pillow keeps only the upper byte
        fault = "has several channels of 16 bits"
        cure = "save labels in one channel of 8 bits"
    elif values.ndim == 3:
        alpha = values[..., -1] if values.shape[-1] in (2, 4) else None
        colours = values if alpha is None else values[..., :-1]
        coloured = (colours != colours[..., :1]).any(axis=-1)
        if coloured.any():
            fault = f"is a colour picture (one pixel is {tuple(colours[coloured][0].tolist())})"
            cure = "save labels in one channel: 0 background, k for the k-th material, 255 leave out"
        elif alpha is not None and (alpha != np.iinfo(alpha.dtype).max).any():
            fault = "has transparent pixels"
            cure = "save it without alpha: 0 is background"
        values = colours[..., 0]
    if fault:
        raise InputError(fault, file=path, key=key, cure=cure)
    return (values // (_STRETCH.get(depth, 1) if colour_type == _GREY else 1)).astype(np.uint16)


def read_inside(path: str | Path, key: str, size: tuple[int, int] | None = None) -> Bool[np.ndarray, "h w"]:
    """Read a mask of one object or material.

    Inside are the values above half of the greatest one, which suits 0/1, 0/255 and soft edges.

    Args:
        path: File.
        key: Key to name in errors.
        size: Expected height and width.

    Returns:
        A mask.
    """
    values = read_values(path, key, size)
    return values > values.max() // 2


def check_size(size: Sequence[int], expected: Sequence[int], path: str | Path, key: str) -> None:
    """Check a size (height, width) against the photo's; the error says so if the mask is rotated by 90°.

    Args:
        size: Size of the mask.
        expected: Size of the photo.
        path: File to name in the error.
        key: Key to name in the error.

    Raises:
        InputError: If they differ.
    """
    if tuple(size) != tuple(expected):
        cure = "save the mask with the photo's own pixels"
        if tuple(size) == tuple(expected)[::-1]:
            cure = "it lies on its side: the photo's EXIF orientation is applied, so mask the photo as it is displayed"
        raise InputError(
            f"the mask is {size[1]} × {size[0]} pixels, the photo {expected[1]} × {expected[0]}",
            file=path,
            key=key,
            cure=cure,
        )


class Rle(msgspec.Struct, frozen=True):
    """Lengths of runs outside, inside, outside, … down the columns; a string is COCO's compressed form."""

    size: tuple[int, int]  # height, width
    counts: list[int] | str


class Annotation(msgspec.Struct, frozen=True):
    """Shape of one object in one image; segmentation (polygons or RLE) stays JSON text until its photo is read."""

    image_id: int | str
    category_id: int | str
    segmentation: msgspec.Raw = msgspec.Raw(b"null")
    id: int | str | None = None


class Category(msgspec.Struct, frozen=True):
    """Category of annotations; its name is that of a material."""

    id: int | str
    name: str


class CocoImage(msgspec.Struct, frozen=True):
    """Image of a COCO file; width and height are in pixels, None if the file does not give them."""

    id: int | str
    file_name: str
    width: int | None = None
    height: int | None = None


class Coco(msgspec.Struct, frozen=True):
    """Contents of a COCO file that are read; others are ignored."""

    images: list[CocoImage]
    annotations: list[Annotation]
    categories: list[Category]


def read_coco(
    path: str | Path, image: str, materials: list[str], size: tuple[int, int], key: str = "masks"
) -> dict[str, Bool[np.ndarray, "h w"]]:
    """Read one mask for each material in one photo, the union of its annotations.

    InputError is raised if an annotation is invalid, or if the image has another size.

    Args:
        path: COCO file.
        image: File name of the photo.
        materials: Materials of the dataset.
        size: Height and width of the photo.
        key: Key to name in errors.
    """
    content = read_bytes(path, "COCO", key, MOST_BYTES)
    with reading("COCO", path, key, "it needs images, annotations and categories"):
        coco = msgspec.json.decode(content, type=Coco)
    entry = _entry(coco, image, path)
    check_size((entry.height or size[0], entry.width or size[1]), size, path, key)
    names = {category.id: category.name for category in coco.categories}
    segmentations: dict[str, list[tuple[str, msgspec.Raw]]] = {}  # by material, with their keys
    for index, annotation in enumerate(coco.annotations):
        if annotation.image_id != entry.id:
            continue
        place = f"annotations[{index}]"
        name = names.get(annotation.category_id)
        if name is None:
            fault = f"category_id is {annotation.category_id!r}, but categories has no such id"
            raise InputError(fault, file=path, key=place, cure="add the category, or correct category_id")
        if name not in materials:
            cure = did_you_mean(name, materials) + " (categories are the dataset's materials)"
            raise InputError(f"category {name!r} is not a material", file=path, key=place, cure=cure)
        segmentations.setdefault(name, []).append((f"{place}.segmentation", annotation.segmentation))
    masks = {}
    length = 0.0  # of all outlines
    for name, entries in segmentations.items():
        shapes = []
        for place, segmentation in entries:
            runs, longer = _shapes(segmentation, size, path, place)
            shapes += [(place, counts) for counts in runs]
            length += longer
            if length > (most := LONGEST_TOGETHER * sum(size)):
                fault = f"all outlines together are {length:.3g} pixels long; at most {most:,} are read"
                raise InputError(fault, file=path, key=place, cure=SIMPLER)
        masks[name] = _union(shapes, size, path)
    return masks


def _union(
    shapes: list[tuple[str, list[int] | str]], size: tuple[int, int], path: str | Path
) -> Bool[np.ndarray, "h w"]:
    """Return the union of shapes that are given as run lengths, each with its key."""
    edges = np.zeros(size[0] * size[1] + 1, np.int32)  # number of shapes that begin at a pixel, less those that end
    for key, counts in shapes:
        with reading("RLE", path, key, CURE):
            borders = np.cumsum(run_lengths(counts, len(edges) - 1))
        np.add.at(edges, borders[0::2], 1)
        np.add.at(edges, borders[1::2], -1)
    return np.ascontiguousarray((np.cumsum(edges[:-1], dtype=np.int32) > 0).reshape(size[::-1]).T)


def run_lengths(counts: list[int] | str, pixels: int) -> Int[np.ndarray, " n"]:
    """Return run lengths, decompressed if they are a string.

    In the compressed form, a character holds 5 bits (+48). Its sixth bit means that more characters follow, and the
    sign is the highest bit of the last. From the third run on, each is the difference to the run two before.

    Raises:
        ValueError: If the runs do not fill the pixels exactly.

    >>> run_lengths([1, 2, 1], 4).tolist(), run_lengths("R47g1", 192).tolist()
    ([1, 2, 1], [130, 7, 55])
    """
    numbers = [] if isinstance(counts, str) else counts
    value = shift = 0
    for code in counts.encode("ascii") if isinstance(counts, str) else ():
        if not 48 <= code < 112 or shift >= 5 * MOST_DIGITS:
            raise ValueError("it is not a compressed RLE, or a run is longer than any picture")
        value |= (code - 48 & 31) << shift
        shift += 5
        if not code - 48 & 32:  # the last character of a run, whose highest bit is the sign
            value -= (code - 48 & 16) << shift - 4
            numbers.append(value + (numbers[-2] if len(numbers) > 2 else 0))
            value = shift = 0
    if shift:
        raise ValueError("its compressed RLE is cut short")
    runs = np.array(numbers, np.int64)
    if runs.min(initial=0) < 0 or runs.max(initial=0) > pixels or runs.sum() != pixels:
        raise ValueError(f"its runs do not fill {pixels} pixels")
    return runs


def _entry(coco: Coco, image: str, path: str | Path) -> CocoImage:
    """Return the image entry of the same path, or else of the same file name."""
    base = PurePosixPath(image).name
    bases = [PurePosixPath(entry.file_name.replace("\\", "/")).name for entry in coco.images]
    entries = [entry for entry in coco.images if PurePosixPath(entry.file_name) == PurePosixPath(image)]
    entries = entries or [entry for entry, name in zip(coco.images, bases) if name == base]
    if not entries:
        raise InputError(
            f"the COCO file has no image {base!r}", file=path, key="images", cure=did_you_mean(base, bases)
        )
    if len(entries) > 1:
        raise InputError(
            f"has {len(entries)} images {base!r}",
            file=path,
            key="images",
            cure=f"keep one, or call one {image!r}",
        )
    return entries[0]


def _shapes(text: msgspec.Raw, shape: tuple[int, int], path: str | Path, key: str) -> tuple[list, float]:
    """Return the run lengths of the parts of a shape, and the total length of its outlines."""
    with reading("a COCO segmentation", path, key, CURE):
        segmentation = msgspec.json.decode(text, type=list[list[float]] | Rle | None)
    if not segmentation:
        raise InputError(
            "is empty: the annotation has only a box", file=path, key=key, cure="draw its outline, or delete it"
        )
    if isinstance(segmentation, Rle):
        if tuple(segmentation.size) != shape:
            raise InputError(
                f"its RLE is {_wh(segmentation.size)} pixels, the image {_wh(shape)}",
                file=path,
                key=key,
                cure="export it at the photo's own size",
            )
        return [segmentation.counts], 0.0
    polygons = []
    length = 0.0
    limit = np.array(shape[::-1])
    for index, polygon in enumerate(segmentation):
        fault = ""
        corners = np.array(polygon)
        cure = "a polygon is [x1, y1, x2, y2, x3, y3, …], three corners or more"
        if len(corners) < 6 or len(corners) % 2 or not np.isfinite(corners).all():
            fault = "is not a polygon"
        elif ((corners := corners.reshape(-1, 2)) < -OVERSHOOT).any() or (corners > limit + OVERSHOOT).any():
            fault = f"has corners outside the image of {_wh(shape)} pixels"
            cure = "clip it to the image; if it was drawn at another size, export it at the photo's own size"
        else:
            corners = np.clip(corners, 0, limit)
            longer = float(np.abs(np.diff(corners, axis=0, append=corners[:1])).max(axis=1).sum())
            if longer > LONGEST * sum(shape):
                fault = f"its outline is {longer:.3g} pixels long; at most {LONGEST * sum(shape):,} are read"
                cure = SIMPLER
        if fault:
            raise InputError(fault, file=path, key=f"{key}[{index}]", cure=cure)
        polygons.append(corners.ravel().tolist())
        length += longer
    return [each["counts"].decode("ascii") for each in pycocomask.frPyObjects(polygons, *shape)], length


def _wh(shape: tuple[int, int]) -> str:
    """Format a size as width × height."""
    return f"{shape[1]} × {shape[0]}"
