"""Readers of mask files: pictures of one channel or of CVAT's colours, and annotations of COCO and labelme.

Pillow reads pictures, because it alone keeps the stored values: palette indices of a PNG, not the palette's colours. It
stretches grey of 2 or 4 bits to 8 bits, which is undone. Pictures are turned as EXIF says. Lossy formats (JPEG, most
WebP) change values by some codes, and by more in blocks about edges: they can be silhouettes, but hold no labels. A
lossy picture is a silhouette if all pixels are black or white to RINGING codes, but a share of MOST_SOFT at its edges.

The file of labelme becomes COCO's; its masks of pixels become RLE. Label Studio and Roboflow change the names of
photos, which is undone. A polygon of fewer than three corners is empty.

COCO masks are polygons, and RLE as counts or compressed, by category and file name. pycocotools fills the polygons. It
needs memory for every pixel of an outline, so the length of outlines is checked first. Run lengths are decoded here:
pycocotools makes a mask of random memory of runs that are cut short. Several shapes give their union, at the cost of
the number of runs and one picture. The shapes of other photos in the file are left as text.
"""

import logging
import re
import warnings
from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from typing import Any, ClassVar

import msgspec
import numpy as np
from jaxtyping import Bool, Int, UInt16
from PIL import Image, ImageOps
from pycocotools import mask as pycocomask
from scipy import ndimage

from factorlib.dataset.paths import nearest_paths, plain_path
from factorlib.dataset.schema import LEFT_OUT
from factorlib.errors import InputError, did_you_mean
from factorlib.reading import check_plain, one_line, read_bytes, read_text, reading

FORMATS = ["PNG", "JPEG", "BMP", "TIFF", "WEBP", "GIF", "TGA"]  # Pillow's names
MODES = ("1", "L", "P", "LA", "RGB", "RGBA", "I;16", "I;16B")  # Pillow's modes whose values are read as they are
RINGING = 32  # greatest error of a lossy format, codes
MOST_SOFT = 0.25  # greatest share of pixels between black and white in a lossy silhouette, of the white ones
BLOCK = 16  # side of a JPEG's blocks where colours have half the resolution, pixels: errors of an edge reach no farther
Image.MAX_IMAGE_PIXELS = None  # Pillow warns at 89 megapixels; a mask has the size of its photo, which is limited
OVERSHOOT = 2.0  # a polygon may leave the image by this many pixels
MOST_BYTES = 512_000_000  # greatest size of a file; a hundred thousand outlines take half of it
LONGEST = 200  # greatest length of an outline, in half perimeters of the photo
LONGEST_TOGETHER = 5000  # greatest length of all outlines of a photo together
MOST_DIGITS = 7  # greatest number of 5-bit digits of a compressed run length: no picture has 2**35 pixels
LARGEST_LABEL = 32  # a PNG with a greater value, except 255, is a soft silhouette
BACKGROUND = "background"  # CVAT's name of what has no label
CHANGED = re.compile(r"^[0-9a-f]{8}-|\.rf\.[0-9a-f]{32}\.\w+$")  # what Label Studio and Roboflow add to a name
SHAPES = ("polygon", "rectangle", "rotation", "mask")  # shapes of labelme and X-AnyLabeling that have an area
CURE = "export the file again"
log = logging.getLogger("factorlib.labels")


def read_values(path: str | Path, key: str, size: tuple[int, int] | None = None) -> UInt16[np.ndarray, "h w"]:
    """Read the stored values of a picture; of a lossy one 0 and 255.

    RGB is accepted only if R = G = B, alpha only if it is opaque.

    Args:
        path: File.
        key: Key to name in errors.
        size: Expected height and width, checked by the header.

    Returns:
        Values.

    Raises:
        InputError: If the file is not such a picture, or has another size.
    """
    return _exact_values(_decode(path, key, size), path, key)


def read_inside(path: str | Path, key: str, size: tuple[int, int] | None = None) -> Bool[np.ndarray, "h w"]:
    """Read a mask of one object or material.

    Inside are the values above half of the greatest one, which suits 0/1, 0/255 and soft edges; of a lossy format those
    above 127. If the picture has transparent pixels, its alpha is the mask.

    Args:
        path: File.
        key: Key to name in errors.
        size: Expected height and width.

    Returns:
        A mask.
    """
    picture = _decode(path, key, size)
    if picture.opaque is not None:
        return picture.opaque
    values = _values(picture, path, key)
    # in the values' own type, of which twice the greatest may be no number
    return values > (LEFT_OUT if picture.lossy else values.max()) // 2


def read_labels_in(path: str | Path, key: str, size: tuple[int, int] | None = None) -> set[int]:
    """Return the labels in a picture; none if it is a silhouette: transparency, 0 and 255, or mostly bright greys.

    Args:
        path: File.
        key: Key to name in errors.
        size: Expected height and width.
    """
    picture = _decode(path, key, size)
    if picture.opaque is not None and (picture.pixels.ndim == 3 or picture.pixels.max() > LARGEST_LABEL):
        return set()
    values = _exact_values(picture, path, key)
    present = set(np.flatnonzero(np.bincount(values.ravel())).tolist()) - {0, LEFT_OUT}
    bright = 2 * np.count_nonzero(values > LEFT_OUT // 2) >= np.count_nonzero(values)
    is_matte = bright and max(present, default=0) > LARGEST_LABEL
    return set() if is_matte else {label for label in present if label < LEFT_OUT}


def opaque_part(alpha: np.ndarray) -> Bool[np.ndarray, "h w"] | None:
    """Return the mask of an alpha channel of integers, cut at half; None if it is the same everywhere."""
    opaque = alpha > alpha.max() // 2
    return opaque if opaque.any() and not opaque.all() else None


def read_colours(
    path: str | Path, labelmap: Path, materials: list[str], size: tuple[int, int], key: str
) -> UInt16[np.ndarray, "h w"] | None:
    """Read the labels of a picture whose colours a labelmap.txt of CVAT names; None for a grey or a lossy one.

    Args:
        path: File.
        labelmap: Lines `name:red,green,blue:…`; `background` is 0.
        materials: Materials of the dataset, in order.
        size: Expected height and width.
        key: Key to name in errors.

    Raises:
        InputError: If a file is damaged, or a colour or name is unknown.
    """
    names = read_labelmap(labelmap)
    with reading("a picture", path, key), Image.open(path, formats=FORMATS) as image:
        if image.mode not in ("P", "RGB", "RGBA") or image.format in ("JPEG", "WEBP"):
            return None
        check_size(image.size[::-1], size, path, key)
        colours = np.asarray(image.convert("RGB")).astype(np.int64) @ (1 << 16, 1 << 8, 1)
    labels = np.zeros(size, np.uint16)
    for colour in np.unique(colours).tolist():
        name = names.get(colour)
        if name != BACKGROUND and name not in materials:
            raise InputError(
                f"has the colour #{colour:06x}, which {labelmap.name} calls {name!r}: not a material",
                file=path,
                key=key,
                cure=f"give {labelmap.name} a line for it, with one of {', '.join(materials)}, or {BACKGROUND}",
            )
        labels[colours == colour] = 0 if name == BACKGROUND else materials.index(name) + 1
    return labels


def read_labelmap(path: Path) -> dict[int, str]:
    """Return the names in a labelmap.txt of CVAT by their colours, 0xRRGGBB."""
    lines = read_text(path, "a labelmap", None, MOST_BYTES).splitlines()
    with reading("a labelmap", path, cure="its lines are name:red,green,blue::"):
        return {
            int.from_bytes(bytes(map(int, colour.split(",")))): name
            for name, colour, *_ in (line.split(":") for line in lines if line.strip() and not line.startswith("#"))
        }


class _Picture(msgspec.Struct, frozen=True):
    """A picture as Pillow decodes it.

    Attributes:
        pixels: values
        opaque: mask of the opaque pixels; None if no pixel is transparent
        raw: Pillow's name of the stored form, such as "L;4" or "RGB;16B"
        lossy: True if its format changes values
    """

    pixels: np.ndarray
    opaque: np.ndarray | None
    raw: str
    lossy: bool


def _decode(path: str | Path, key: str, size: tuple[int, int] | None) -> _Picture:
    """Decode a picture as displayed, and check its size."""
    check_plain(path, "a picture", key)
    with (
        warnings.catch_warnings(action="ignore"),  # of metadata
        reading("a picture", path, key, "save the mask again, as PNG; of a Cryptomatte the matte of each material"),
        Image.open(path, formats=FORMATS) as image,
    ):
        if size and sorted(image.size) != sorted(size):  # before anything is decoded
            check_size(image.size[::-1], size, path, key)
        if getattr(image, "n_frames", 1) > 1 or image.mode in ("I", "F"):
            raise InputError(
                "holds several pictures, or values of 32 bits",
                file=path,
                key=key,
                cure="save one picture of 8 or 16 bits, as PNG",
            )
        raw = re.search(r"\b(L|LA|RGB|RGBA);\d+", str(image.tile))
        lossy = image.format == "JPEG" or image.info.get("compression") in ("jpeg", "tiff_jpeg", "webp")
        lossy |= image.format == "WEBP" and b"VP8L" not in Path(path).read_bytes()[: 1 << 16]
        ImageOps.exif_transpose(image, in_place=True)
        check_size(image.size[::-1], size or image.size[::-1], path, key)
        plain = image.mode in MODES and (image.mode != "P" or image.format == "PNG")  # others may reorder a palette
        decoded = image if plain else image.convert("RGBA" if image.has_transparency_data else "RGB")
        has_alpha = decoded.mode in ("P", "LA", "RGBA") and decoded.has_transparency_data
        opaque = opaque_part(np.asarray(decoded.convert("RGBA"))[..., 3]) if has_alpha else None
    return _Picture(np.asarray(decoded), opaque, raw[0] if raw else "", lossy)


def _exact_values(picture: _Picture, path: str | Path, key: str) -> UInt16[np.ndarray, "h w"]:
    """Return the values of a decoded picture; if it is lossy, 0 and 255, which it must be near but about edges."""
    values = _values(picture, path, key)
    if picture.lossy:
        white = values >= LEFT_OUT - RINGING
        soft = (values > RINGING) & ~white
        # a label between black and white fills more than what the errors of two edges, on either side, reach
        is_label = ndimage.minimum_filter(soft, 2 * BLOCK + 1, mode="nearest").any()
        if values.any() and (is_label or np.count_nonzero(soft) >= MOST_SOFT * np.count_nonzero(white)):
            raise InputError(
                "is of a lossy format, which changes labels",
                file=path,
                key=key,
                cure="save labels as PNG; or, if it shows one material, write masks: {material: file}",
            )
        values = np.where(values > LEFT_OUT // 2, LEFT_OUT, 0).astype(np.uint16)
    return values


def _values(picture: _Picture, path: str | Path, key: str) -> UInt16[np.ndarray, "h w"]:
    """Return the stored values of a decoded picture; InputError for colours and transparency.

    Of a lossy picture some pixels at the edges may have colours; their value is the mean of the channels.
    """
    values = picture.pixels
    if values.ndim == 3:
        if ";16" in picture.raw:  # Pillow keeps only the upper byte
            cure = "save labels in one channel of 8 bits"
            raise InputError("has several channels of 16 bits", file=path, key=key, cure=cure)
        if picture.opaque is not None:
            cure = "save it without alpha: 0 is background; or, if it shows one material, write masks: {material: file}"
            raise InputError("has transparent pixels", file=path, key=key, cure=cure)
        colours = values[..., : 1 if values.shape[-1] == 2 else 3]
        coloured = np.ptp(colours, axis=-1) > (RINGING if picture.lossy else 0)
        white = np.count_nonzero(colours.min(axis=-1) >= LEFT_OUT - RINGING) if picture.lossy else 0
        if np.count_nonzero(coloured) > MOST_SOFT * white:
            raise InputError(
                f"is a colour picture (one pixel is {tuple(colours[coloured][0].tolist())})",
                file=path,
                key=key,
                cure="save labels in one channel: 0 background, k for the k-th material, 255 leave out",
            )
        values = colours.sum(axis=-1, dtype=np.uint16) // colours.shape[-1]
    return (values // {"L;2": 85, "L;4": 17}.get(picture.raw, 1)).astype(np.uint16)  # the code of 1 in stretched grey


def check_size(size: Sequence[float], expected: Sequence[int], path: str | Path, key: str) -> None:
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
        raise InputError(
            f"the mask is {size[1]:g} × {size[0]:g} pixels, the photo {expected[1]} × {expected[0]}",
            file=path,
            key=key,
            cure="it lies on its side: the photo's EXIF orientation is applied, so mask the photo as it is displayed"
            if tuple(size) == tuple(expected)[::-1]
            else "save the mask with the photo's own pixels",
        )


class Rle(msgspec.Struct, frozen=True):
    """Lengths of runs outside, inside, outside, … down the columns; a string is COCO's compressed form.

    Attributes:
        size: height, width
        mask: PNG of labelme, in place of runs
        points: corners of its box
    """

    size: tuple[int, int] = (0, 0)
    counts: list[int] | str = ""
    mask: bytes | None = None
    points: list[tuple[float, float]] = []


class Annotation(msgspec.Struct, frozen=True):
    """Shape of one object in one image; segmentation (polygons or RLE) stays JSON text until its photo is read."""

    image_id: int | str
    category_id: int | str
    segmentation: msgspec.Raw = msgspec.Raw(b"null")


class Category(msgspec.Struct, frozen=True):
    """Category of annotations; its name is that of a material. A supercategory may be a category itself."""

    id: int | str
    name: str
    supercategory: Any = None


class CocoImage(msgspec.Struct, frozen=True):
    """Image of a COCO file; width and height are in pixels, None if the file does not give them."""

    id: int | str
    file_name: str
    width: float | None = None
    height: float | None = None


class Coco(msgspec.Struct, frozen=True):
    """Contents of a COCO file that are read; others are ignored."""

    PLACE: ClassVar[str] = "annotations[{}].segmentation"
    images: list[CocoImage]
    annotations: list[Annotation]
    categories: list[Category]


class LabelmeCoco(Coco, frozen=True):
    """Shapes of labelme as COCO's."""

    PLACE: ClassVar[str] = "shapes[{}]"


class LabelmeShape(msgspec.Struct, frozen=True):
    """Shape of labelme: corners of a polygon, or opposite ones of a rectangle, or of the box of a mask, a PNG."""

    label: str
    points: list[tuple[float, float]]
    shape_type: Any = "polygon"
    mask: bytes | None = None


class Labelme(msgspec.Struct, frozen=True):
    """Contents of a file of labelme that are read: the shapes of one photo."""

    shapes: list[LabelmeShape]
    imageHeight: float | None = None
    imageWidth: float | None = None


def read_annotations(path: str | Path, image: str = "", key: str | None = None) -> Coco:
    """Read a file of COCO, or one of labelme as COCO's; InputError if it is neither.

    Args:
        path: File.
        image: File name of the photo, to which the shapes of labelme belong.
        key: Key to name in errors.
    """
    content = read_bytes(path, "COCO", key, MOST_BYTES)
    with reading("COCO", path, key, "it needs images, annotations and categories; or shapes, as labelme's has"):
        try:
            labelme = msgspec.json.decode(content, type=Labelme)
        except msgspec.ValidationError:
            if b'"annotations"' not in content and b'"shapes"' in content:
                raise
            return msgspec.json.decode(content, type=Coco)
        for k, shape in enumerate(labelme.shapes):
            if shape.shape_type not in SHAPES:
                raise InputError(
                    f"{one_line(repr(shape.shape_type))} is not read, but {', '.join(SHAPES)} are",
                    file=path,
                    key=f"shapes[{k}].shape_type",
                    cure="draw its outline, or delete it",
                )
        return LabelmeCoco(
            [CocoImage(0, image, labelme.imageWidth, labelme.imageHeight)],
            [Annotation(0, shape.label, msgspec.Raw(_segmentation(shape))) for shape in labelme.shapes],
            [Category(name, name) for name in dict.fromkeys(shape.label for shape in labelme.shapes)],
        )


def _segmentation(shape: LabelmeShape) -> bytes:
    """Return COCO's text of a shape, whose pixels, if it is a mask, stay a PNG until its photo is read."""
    if shape.shape_type == "mask":
        return msgspec.json.encode(Rle(mask=shape.mask or b"", points=shape.points))
    points = np.array(shape.points)
    if shape.shape_type == "rectangle":  # two opposite corners, or all four
        points = np.where([[0, 0], [1, 0], [1, 1], [0, 1]], points.max(axis=0), points.min(axis=0))
    return msgspec.json.encode([points.ravel().tolist()])


def _runs_of_mask(shape: Rle, size: tuple[int, int], path: str | Path, key: str) -> str:
    """Return the run lengths of a mask of labelme in a picture of a size."""
    inside = np.zeros(size, np.uint8, order="F")
    with reading("a mask", path, key, CURE), Image.open(BytesIO(shape.mask or b""), formats=["PNG"]) as image:
        left, top = np.round(shape.points[0]).astype(int)
        if min(left, top) < 0 or image.width > size[1] - left or image.height > size[0] - top:
            raise ValueError(f"its {image.width} × {image.height} pixels at ({left}, {top}) leave the photo")
        inside[top : top + image.height, left : left + image.width] = np.asarray(image.convert("L")) > 0
    return pycocomask.encode(inside)["counts"].decode("ascii")


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
    coco = read_annotations(path, image, key)
    entry = _entry(coco, image, path)
    with reading("COCO", path, key, CURE):
        _check_stated_size(coco, entry, size, path, key)
    names = {category.id: category.name for category in coco.categories}
    segmentations: dict[str, list[tuple[str, msgspec.Raw]]] = {}  # by material, with their keys
    for index, annotation in enumerate(coco.annotations):
        if annotation.image_id != entry.id:
            continue
        place = coco.PLACE.format(index)
        name = names.get(annotation.category_id)
        if name is None:
            fault = f"category_id is {annotation.category_id!r}, but categories has no such id"
            raise InputError(fault, file=path, key=f"annotations[{index}]", cure="add it, or correct category_id")
        if name not in materials:
            cure = did_you_mean(name, materials) + " (categories are the dataset's materials)"
            raise InputError(f"category {name!r} is not a material", file=path, key=place.partition(".")[0], cure=cure)
        segmentations.setdefault(name, []).append((place, annotation.segmentation))
    masks = {}
    length = 0.0  # of all outlines
    for name, entries in segmentations.items():
        shapes = []
        for place, segmentation in entries:
            runs, longer = _shapes(segmentation, size, path, place)
            shapes += [(place, counts) for counts in runs]
            length += longer
            _check_length(length, LONGEST_TOGETHER, "all outlines together are", size, path, place)
        masks[name] = _union(shapes, size, path)
    return masks


def _check_length(length: float, most: int, words: str, size: tuple[int, int], path: str | Path, key: str) -> None:
    """Check the length of outlines against `most` half perimeters of the photo."""
    if length > most * sum(size):
        raise InputError(
            f"{words} {length:.3g} pixels long; at most {most * sum(size):,} are read",
            file=path,
            key=key,
            cure="draw outlines with fewer corners, or export the file again",
        )


def _check_stated_size(coco: Coco, entry: CocoImage, size: tuple[int, int], path: str | Path, key: str) -> None:
    """Check the size that a file states; that of a photo on its side may be the stored one, which an outline leaves."""
    height, width = stated = (entry.height or size[0], entry.width or size[1])
    if stated == size[::-1] != size:
        shapes = [bytes(shape.segmentation) for shape in coco.annotations if shape.image_id == entry.id]
        outlines = [outline for text in shapes if text[:1] == b"[" for outline in msgspec.json.decode(text)]
        if any(max(each[::2], default=0) > width or max(each[1::2], default=0) > height for each in outlines):
            return
    check_size(stated, size, path, key)


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
    place = plain_path(image)
    base = place.name
    places = [plain_path(entry.file_name) for entry in coco.images]
    same = [path for path in places if path == place] or [path for path in places if path.name == base]
    plain = base.replace(".", "_")  # Roboflow's kitchen_jpg.rf.<digits>.jpg
    same = same or [path for path in places if CHANGED.sub("", path.name) in (base, plain)]
    nearest = nearest_paths(place, same)
    entries = [entry for entry, path in zip(coco.images, places) if path in nearest]
    if len(entries) != 1:
        raise InputError(
            f"the file has {len(entries) or 'no'} image{'s' * (len(entries) > 1)} {base!r}",
            file=path,
            key="images",
            cure=f"keep one, or call one {image!r}" if entries else did_you_mean(base, [path.name for path in places]),
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
        if segmentation.mask is not None:
            return [_runs_of_mask(segmentation, shape, path, key)], 0.0
        if tuple(segmentation.size) != shape:
            raise InputError(
                f"its RLE is {segmentation.size[1]} × {segmentation.size[0]} pixels, the image {shape[1]} × {shape[0]}",
                file=path,
                key=key,
                cure="export it at the photo's own size",
            )
        return [segmentation.counts], 0.0
    polygons = []
    length = 0.0
    limit = np.array(shape[::-1])
    for index, polygon in enumerate(segmentation):
        place = f"{key}[{index}]"
        corners = np.array(polygon)
        if len(corners) in (0, 2, 4):
            log.warning("%s: %s: fewer than three corners: it counts as empty", path, place)
            continue
        if len(corners) % 2 or not np.isfinite(corners).all():
            cure = "a polygon is [x1, y1, x2, y2, x3, y3, …], three corners or more"
            raise InputError("is not a polygon", file=path, key=place, cure=cure)
        corners = corners.reshape(-1, 2)
        if (corners < -OVERSHOOT).any() or (corners > limit + OVERSHOOT).any():
            fault = f"has corners outside the image of {shape[1]} × {shape[0]} pixels"
            cure = "clip it to the image; if it was drawn at another size, export it at the photo's own size"
            raise InputError(fault, file=path, key=place, cure=cure)
        corners = np.clip(corners, 0, limit)
        longer = float(np.abs(np.diff(corners, axis=0, append=corners[:1])).max(axis=1).sum())
        _check_length(longer, LONGEST, "its outline is", shape, path, place)
        polygons.append(corners.ravel().tolist())
        length += longer
    runs = pycocomask.frPyObjects(polygons, *shape) if polygons else []
    return [each["counts"].decode("ascii") for each in runs], length
