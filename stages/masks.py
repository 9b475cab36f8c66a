"""Photo and masks to one EXR of linear radiance, labels, and which pixels can be used, no larger than is useful."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np

from factorlib.dataset.schema import LEFT_OUT, PhotoSlice
from factorlib.errors import InputError
from factorlib.images.boxes import box_majority, least_factor
from factorlib.images.exr import write_exr
from factorlib.images.limits import MOST_MEGAPIXELS, check_pixels
from factorlib.images.photo import Photo, check_bright, decoded, open_photo
from factorlib.labels import Labels, read_labels, read_objects
from factorlib.results.photos import PhotoFacts, write_photo_facts
from factorlib.stage import Inputs, Progress, silent

log = logging.getLogger("factorlib.masks")


class Params(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A photo that has more pixels than these is averaged down by the least whole factor that makes it fit."""

    pixels: Annotated[int, msgspec.Meta(ge=100)] = 1_000_000
    """Most pixels that show a material."""
    frame: Annotated[int, msgspec.Meta(ge=100)] = 4_000_000
    """Most pixels of the whole photo, whatever they show."""
    most_megapixels: Annotated[float, msgspec.Meta(gt=0)] = MOST_MEGAPIXELS
    """Most megapixels of a photo's file, by its header; a larger one is refused before it is read."""


def main(params: Params, inputs: Inputs, out: Path, progress: Progress = silent) -> None:
    """Write `<photo>.exr` and `<photo>.json`.

    EXR, float32: R G B (linear Rec. 709, up to exposure), label (0 background, k), valid (1 = has a material and is
    finite), clipped.R/G/B, left_out (neither background nor a material), object (1-based, by its own mask; 0 unsaid).
    """
    facts = msgspec.convert(inputs.facts["dataset.photo"], PhotoSlice)
    materials = inputs.facts["dataset.materials"]
    name = inputs.photo
    path, key = inputs.file(facts.image), f"photos[{name}].image"
    stored = open_photo(path, key)
    check_pixels(stored.size, params.most_megapixels, path, key)
    progress(0, 3, f"{name}: masks")  # before the photo: they say how far it is averaged down while it is read
    labels = read_labels(facts.masks, inputs.file, materials, stored.size, facts.image, f"photos[{name}].masks")
    objects = read_objects(
        [(o.name, o.mask) for o in facts.objects], inputs.file, stored.size, f"photos[{name}].objects"
    )
    factor = factor_of(labels, params)
    labels, objects = reduced(labels, factor, path, f"photos[{name}].masks"), box_majority(objects, factor)
    progress(1, 3, f"{name}: photo")
    photo = decoded(stored, facts.encoding, factor, path)
    valid = _valid(photo, labels, path, key)
    progress(2, 3, f"{name}: writing")
    write_exr(out / f"{name}.exr", _channels(photo, labels, valid, objects))
    write_photo_facts(out / f"{name}.json", _summary(photo, labels, valid, facts, materials, stored.size))
    progress(3, 3, name)


def factor_of(labels: Labels, params: Params) -> int:
    """The least by which the photo fits both of the bounds."""
    height, width = labels.label.shape
    factor = max(
        least_factor(int(np.count_nonzero(labels.label)), params.pixels), least_factor(height * width, params.frame)
    )
    return min(factor, height, width)


def reduced(labels: Labels, factor: int, path: Path, key: str) -> Labels:
    """By majority, where being left out counts as a label."""
    if factor == 1:
        return labels
    label = box_majority(np.where(labels.left_out, np.uint8(LEFT_OUT), labels.label), factor)
    left_out = label == LEFT_OUT
    label[left_out] = 0
    if not label.any():
        found = f"averaged down {factor} × {factor}, no pixel shows mostly one material: the mask is made of specks"
        raise InputError(
            found, file=path, key=key, cure='SET="masks.frame=…" with more pixels, or a mask of whole objects'
        )
    return Labels(label, left_out)


def _valid(photo: Photo, labels: Labels, path: Path, key: str) -> np.ndarray:
    """Pixels of a material that are numbers, [h, w]; if some are not, a warning; if none are, InputError."""
    inside = labels.label > 0
    lost = int((inside & ~photo.finite).sum())
    if lost == int(inside.sum()):
        raise InputError(
            "every pixel in its mask is NaN or infinite", file=path, key=key, cure="render or develop the photo again"
        )
    check_bright(photo, inside, path, key)
    if lost:
        log.warning(
            "%s: %d of the %d pixels in its mask are NaN or infinite: they are not used", path, lost, int(inside.sum())
        )
    return inside & photo.finite


def _channels(photo: Photo, labels: Labels, valid: np.ndarray, objects: np.ndarray) -> dict[str, np.ndarray]:
    colours = {c: photo.radiance[..., k] for k, c in enumerate("RGB")}
    clipped = {f"clipped.{c}": photo.clipped[..., k] for k, c in enumerate("RGB")}
    return {**colours, "label": labels.label, "valid": valid, "left_out": labels.left_out, "object": objects, **clipped}


def _summary(
    photo: Photo, labels: Labels, valid: np.ndarray, facts: PhotoSlice, materials: list[str], size: tuple[int, int]
) -> PhotoFacts:
    """`pixels` counts the valid ones of each material; `clipped_fraction` is the share of them clipped in any channel.

    All pixels are those of the EXR; `original_size` (width, height) is the photo's own, `factor` times as large, as displayed.
    """
    focal_px = facts.focal_px / photo.factor if facts.focal_px else photo.focal_px
    return PhotoFacts(
        width=photo.width,
        height=photo.height,
        factor=photo.factor,
        original_size=(size[1], size[0]),
        focal_px=focal_px,
        focal_source="dataset" if facts.focal_px else "exif" if photo.focal_px else None,
        encoding=photo.encoding,
        exposure=photo.exposure,
        illumination=facts.illumination,
        pixels={material: int((labels.label[valid] == k).sum()) for k, material in enumerate(materials, 1)},
        clipped_fraction=float(photo.clipped[valid].any(axis=-1).mean()),
    )
