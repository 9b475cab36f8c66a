"""Contact sheet of a dataset, for inspection before a solve: photos, labels, and meshes in the labels' colours.

A row shows one photo.  The first picture is the photo.  The second is the photo in grey, with materials in their
colours and left-out pixels hatched.  The others are the objects' meshes in their own frames, from the +z side with +y
up.  Their parts have the colours of their materials in this photo.  An unfinished data set is shown as far as possible:
the material of an open part is called `?`.
"""

from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageColor, ImageDraw

from factorlib.dataset.read_dataset import FILE, OPEN, UNKNOWN, read_draft
from factorlib.dataset.schema import DatasetFile, PhotoEntry
from factorlib.errors import InputError
from factorlib.geometry.camera import Camera, Pose
from factorlib.geometry.raster import rasterise
from factorlib.images.photo import decode_photo, open_photo
from factorlib.images.picture import nearest_tags, picture, png_bytes
from factorlib.images.scanlines import MOST_MEGAPIXELS, check_pixels
from factorlib.images.tone import srgb_decode
from factorlib.labels.label_image import Labels, read_labels
from factorlib.meshes.mesh import Mesh
from factorlib.meshes.read_mesh import read_mesh
from factorlib.reading import path_inside
from factorlib.wholefile import write_bytes

SIDE = 320  # longer side of a photo, pixels
MESH_SIDE = 240  # side of a mesh's picture, pixels
MARGIN = 12  # margin between pictures, pixels
HEAD = 18  # height of a line of text, pixels
PAPER = (255, 255, 255)
INK = (30, 30, 30)
DISTANCE = 6.0  # distance of the camera from a mesh, in its radii
HATCH = 8  # spacing of hatching lines, pixels
MOST_PHOTOS = 100

Pixels = UInt8[np.ndarray, "h w 3"]


def write_sheet(folder: Path, path: Path, report: Callable[[int, int], None] = lambda index, total: None) -> None:
    """Write the contact sheet of the dataset in a folder as a PNG, of its first MOST_PHOTOS photos.

    Photos and meshes that cannot be read are left out, because `validate` reports them.

    Args:
        folder: folder of the dataset
        path: the file to write
        report: receives the number of pieces done and their total, two per photo

    Raises:
        InputError: dataset.yaml does not name photos.
    """
    spec, faults = read_draft(folder / FILE)
    names = list(dict.fromkeys([*spec.materials, *[OPEN] * bool(faults)]))
    photos = spec.photos[:MOST_PHOTOS]
    pictures = []
    for index, photo in enumerate(photos):
        report(index, 2 * len(photos))
        pictures.append(_photo(folder, spec, photo))
    colours = _colours(names, [(image, labels) for image, labels in pictures if labels is not None])
    rows = []
    for index, (photo, (image, labels)) in enumerate(zip(photos, pictures, strict=True)):
        report(len(photos) + index, 2 * len(photos))
        named = [(photo.name, image)]
        if labels is not None:
            named.append(("labels", _colour_labels(image, labels, colours)))
        for obj in photo.objects:
            entry = spec.meshes.get(obj.mesh)
            if entry and entry.file:  # neither left open, nor reconstructed from the masks
                with suppress(InputError, ValueError):
                    mesh = read_mesh(path_inside(folder, entry.file), names, entry.part_materials, obj.materials)
                    named.append((obj.name, render_mesh(mesh, colours)))
        titled = []
        for title, each in named:
            head = Image.new("RGB", (each.shape[1], HEAD), PAPER)
            ImageDraw.Draw(head).text((0, 2), title, fill=INK)
            titled.append(np.concatenate([np.asarray(head), each]))
        tall = max(len(each) for each in titled) + MARGIN
        rows.append(np.concatenate([_pad(each, tall, each.shape[1] + MARGIN) for each in titled], axis=1))
    rows.insert(0, legend([UNKNOWN if name == OPEN else name for name in names], colours, rows[0].shape[1]))
    wide = max(row.shape[1] for row in rows)
    write_bytes(path, png_bytes(np.concatenate([_pad(row, len(row), wide) for row in rows])))


def _photo(folder: Path, spec: DatasetFile, photo: PhotoEntry) -> tuple[Pixels, Labels | None]:
    """Return the photo, averaged down, and its labels, subsampled; white and None if they cannot be read."""
    key = f"photos[{photo.name}]"
    file = partial(path_inside, folder)
    image = np.full((SIDE, SIDE, 3), 255, np.uint8)
    labels = None
    with suppress(InputError, ValueError):
        stored = open_photo(file(photo.image), f"{key}.image")
        check_pixels(stored.size, MOST_MEGAPIXELS, photo.image)
        factor = max(1, -(-max(stored.size) // SIDE))
        image = picture(decode_photo(stored, photo.encoding, factor, file(photo.image)).radiance, 1.0)
        whole = read_labels(photo.masks or OPEN, file, spec.materials, stored.size, photo.image, f"{key}.masks")
        height, width = image.shape[:2]
        fewer = slice(factor // 2, factor * height, factor), slice(factor // 2, factor * width, factor)
        labels = Labels(whole.label[fewer], whole.left_out[fewer])
    return image, labels


def _colour_labels(image: Pixels, labels: Labels, colours: UInt8[np.ndarray, "k 3"]) -> Pixels:
    grey = np.repeat((0.3 * image.mean(axis=-1, keepdims=True) + 150).astype(np.uint8), 3, axis=-1)
    tinted = (0.75 * colours[labels.label] + 0.25 * image).astype(np.uint8)
    pixels = np.where(labels.label[..., None] > 0, tinted, grey)
    row, column = np.indices(labels.label.shape)
    pixels[labels.left_out & ((row + column) % HATCH < HATCH // 4)] = 0
    return pixels


def render_mesh(mesh: Mesh, by_label: UInt8[np.ndarray, "k 3"]) -> Pixels:
    """Render a mesh in the colours of its labels, shaded by a light at the camera."""
    camera = Camera(MESH_SIDE, MESH_SIDE, MESH_SIDE * DISTANCE / 2.2, (MESH_SIDE / 2, MESH_SIDE / 2))
    rotation = np.diag([1.0, -1.0, -1.0])
    maps = rasterise(mesh, camera, Pose(rotation, np.array([0, 0, DISTANCE * mesh.radius]) - rotation @ mesh.centre))
    facing = np.clip(np.einsum("hwc,hwc->hw", maps.normal, maps.view), 0, 1)[..., None]
    shaded = by_label[maps.label].astype(float) * (0.35 + 0.65 * facing)
    return np.where(maps.label[..., None] > 0, shaded, 255).astype(np.uint8)


def _colours(names: list[str], pictures: list[tuple[Pixels, Labels]]) -> UInt8[np.ndarray, "k 3"]:
    """Return distinct colours by label, near the photos' mean colours; row 0 is the background's."""
    pixels = np.concatenate([np.zeros((0, 3)), *(image.reshape(-1, 3) for image, _ in pictures)])
    labels = np.concatenate([np.zeros(0), *(labels.label.ravel() for _, labels in pictures)])
    material_pixels = [pixels[labels == k] for k in range(1, len(names) + 1)]
    mean = [each.mean(axis=0) / 255 if len(each) else np.full(3, 0.5) for each in material_pixels]
    tags = nearest_tags(names, srgb_decode(np.array(mean)))
    return np.array([PAPER, *(ImageColor.getrgb(tags[name]) for name in names)], np.uint8)


def legend(names: list[str], by_label: UInt8[np.ndarray, "k 3"], width: int) -> Pixels:
    """Render the materials' names and colours, one a line; a longer name than `width` pixels widens the legend.

    Args:
        names: names of the materials
        by_label: colours by label
        width: width in pixels
    """
    longest = max(ImageDraw.Draw(Image.new("RGB", (1, 1))).textlength(name) for name in names)
    sheet = Image.new("RGB", (max(width, int(longest) + HEAD + 2 * MARGIN), len(names) * HEAD + 2 * MARGIN), PAPER)
    pen = ImageDraw.Draw(sheet)
    for y, name, colour in zip(range(MARGIN, sheet.height, HEAD), names, by_label[1:].tolist()):
        pen.rectangle((MARGIN, y, MARGIN + HEAD - 4, y + HEAD - 4), fill=tuple(colour), outline=INK)
        pen.text((MARGIN + HEAD, y), name, fill=INK)
    return np.asarray(sheet)


def _pad(pixels: Pixels, height: int, width: int) -> Pixels:
    return np.pad(pixels, ((0, height - pixels.shape[0]), (0, width - pixels.shape[1]), (0, 0)), constant_values=255)
