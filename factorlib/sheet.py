"""A contact sheet of a dataset, to be looked at before anything is solved: each photo, its labels, and the meshes in the labels' colours.

A row for each photo: the photo; the same in grey, materials in their colours and what is left out hatched; each object's mesh as it lies
in its file, seen from the +z side with +y up, its parts in the colours of their materials in this photo.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageDraw

from factorlib.dataset.read import read_dataset
from factorlib.dataset.schema import Dataset, ObjectEntry, PhotoEntry
from factorlib.geometry.camera import Camera, Pose
from factorlib.geometry.raster import rasterise
from factorlib.images.palette import nearest_tags, rgb_of
from factorlib.images.photo import decoded, open_photo
from factorlib.images.picture import picture, png_bytes
from factorlib.images.transfer import srgb_decode
from factorlib.labels import Labels, read_labels
from factorlib.meshes.mesh import Mesh
from factorlib.meshes.read import read_mesh
from factorlib.wholefile import write_bytes

SIDE, MESH_SIDE, MARGIN, HEAD = (
    320,
    240,
    12,
    18,
)  # pixels of a photo's longer side, of a mesh, between pictures, and of a line of text
PAPER, INK = (255, 255, 255), (30, 30, 30)
DISTANCE = 6.0  # of the camera from a mesh, in its radii
HATCH = 8  # pixels from line to line

Pixels = UInt8[np.ndarray, "h w 3"]


def write_sheet(folder: Path, path: Path, report: Callable[[int, int], None] = lambda done, total: None) -> None:
    """The sheet of the dataset in `folder` as a PNG; report: how many pieces are done of how many, two a photo."""
    dataset = read_dataset(folder)
    photos, pictures = dataset.spec.photos, []
    for done, photo in enumerate(photos):
        report(done, 2 * len(photos))
        pictures.append(_photo(dataset, photo))
    colours = _colours(dataset.spec.materials, pictures)
    rows = [_legend(dataset.spec.materials, colours)]
    for done, (photo, (image, labels)) in enumerate(zip(photos, pictures, strict=True)):
        report(len(photos) + done, 2 * len(photos))
        named = [(photo.name, image), ("labels", _coloured(image, labels, colours))]
        named += [(obj.name, drawn(_mesh(dataset, obj), colours)) for obj in photo.objects]
        rows.append(_beside([_titled(title, pixels) for title, pixels in named]))
    write_bytes(path, png_bytes(np.concatenate(_of_one_width(rows))))


def _photo(dataset: Dataset, photo: PhotoEntry) -> tuple[Pixels, Labels]:
    """Both averaged down, or every so many pixels taken."""
    key, path = f"photos[{photo.name}]", dataset.folder / photo.image
    stored = open_photo(path, f"{key}.image")
    factor = max(1, -(-max(stored.size) // SIDE))
    image = picture(decoded(stored, photo.encoding, factor, path).radiance, 1.0)
    labels = read_labels(
        photo.masks,
        lambda name: dataset.folder / name,
        dataset.spec.materials,
        stored.size,
        photo.image,
        f"{key}.masks",
    )
    height, width = image.shape[:2]
    fewer = slice(factor // 2, factor * height, factor), slice(factor // 2, factor * width, factor)
    return image, Labels(labels.label[fewer], labels.left_out[fewer])


def _coloured(image: Pixels, labels: Labels, colours: UInt8[np.ndarray, "k 3"]) -> Pixels:
    grey = np.repeat((0.3 * image.mean(axis=-1, keepdims=True) + 150).astype(np.uint8), 3, axis=-1)
    tint = colours[labels.label]
    shown = np.where(labels.label[..., None] > 0, (0.75 * tint + 0.25 * image).astype(np.uint8), grey)
    row, column = np.indices(labels.label.shape)
    shown[labels.left_out & ((row + column) % HATCH < HATCH // 4)] = 0
    return shown


def _mesh(dataset: Dataset, obj: ObjectEntry) -> Mesh:
    entry = dataset.spec.meshes[obj.mesh]
    return read_mesh(dataset.folder / entry.file, dataset.spec.materials, entry.made_of, obj.materials)


def drawn(mesh: Mesh, by_label: UInt8[np.ndarray, "k 3"]) -> Pixels:
    """A mesh in the colours of its labels, shaded as from a light at the camera."""
    camera = Camera(MESH_SIDE, MESH_SIDE, MESH_SIDE * DISTANCE / 2.2, (MESH_SIDE / 2, MESH_SIDE / 2))
    rotation = np.diag([1.0, -1.0, -1.0])
    maps = rasterise(mesh, camera, Pose(rotation, np.array([0, 0, DISTANCE * mesh.radius]) - rotation @ mesh.centre))
    colours = by_label[maps.label].astype(float)
    facing = np.clip(np.einsum("hwc,hwc->hw", maps.normal, maps.view), 0, 1)[..., None]
    return np.where(maps.label[..., None] > 0, colours * (0.35 + 0.65 * facing), 255).astype(np.uint8)


def _colours(names: list[str], pictures: list[tuple[Pixels, Labels]]) -> UInt8[np.ndarray, "k 3"]:
    """By label, distinct and near to what the photos show there; row 0 is the background's."""
    pixels, labels = (
        np.concatenate(parts) for parts in zip(*((i.reshape(-1, 3), p.label.ravel()) for i, p in pictures), strict=True)
    )
    mean = [
        pixels[labels == k].mean(axis=0) / 255 if (labels == k).any() else np.full(3, 0.5)
        for k in range(1, len(names) + 1)
    ]
    tags = nearest_tags(names, srgb_decode(np.array(mean)))
    return np.array([PAPER, *(rgb_of(tags[name]) for name in names)], np.uint8)


def _legend(names: list[str], by_label: UInt8[np.ndarray, "k 3"]) -> Pixels:
    """The materials and their colours."""
    colours = by_label[1:]
    width = sum(_width(name) + HEAD + 2 * MARGIN for name in names) + MARGIN
    sheet = Image.new("RGB", (width, HEAD + 2 * MARGIN), PAPER)
    pen, x = ImageDraw.Draw(sheet), MARGIN
    for k, name in enumerate(names):
        pen.rectangle((x, MARGIN, x + HEAD - 4, MARGIN + HEAD - 4), fill=tuple(int(c) for c in colours[k]), outline=INK)
        pen.text((x + HEAD, MARGIN), name, fill=INK)
        x += _width(name) + HEAD + 2 * MARGIN
    return np.asarray(sheet)


def _width(text: str) -> int:
    return int(ImageDraw.Draw(Image.new("RGB", (1, 1))).textlength(text)) + 1


def _titled(title: str, pixels: Pixels) -> Pixels:
    head = Image.new("RGB", (pixels.shape[1], HEAD), PAPER)
    ImageDraw.Draw(head).text((0, 2), title, fill=INK)
    return np.concatenate([np.asarray(head), pixels])


def _beside(pictures: list[Pixels]) -> Pixels:
    tall = max(len(each) for each in pictures) + MARGIN
    return np.concatenate([_padded(each, tall, each.shape[1] + MARGIN) for each in pictures], axis=1)


def _of_one_width(rows: list[Pixels]) -> list[Pixels]:
    wide = max(row.shape[1] for row in rows)
    return [_padded(row, len(row), wide) for row in rows]


def _padded(pixels: Pixels, height: int, width: int) -> Pixels:
    pad = ((0, height - pixels.shape[0]), (0, width - pixels.shape[1]), (0, 0))
    return np.pad(pixels, pad, constant_values=255)
