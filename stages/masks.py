"""Photo and masks to one EXR of linear radiance, labels, and which pixels can be used."""

from __future__ import annotations

import logging
from pathlib import Path

import msgspec
import numpy as np

from factorlib.dataset.schema import PhotoSlice
from factorlib.errors import InputError
from factorlib.images.exr import write_exr
from factorlib.images.photo import Photo, read_photo
from factorlib.jsonfile import write_json
from factorlib.labels import Labels, read_labels, read_objects
from factorlib.stage import Inputs, Progress, silent

log = logging.getLogger("factorlib.masks")


class Params(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Nothing to choose: what a photo and its masks mean stands in dataset.yaml."""


def main(params: Params, inputs: Inputs, out: Path, progress: Progress = silent) -> None:
    """Write `<photo>.exr` and `<photo>.json`.

    EXR, float32: R G B (linear Rec. 709, up to exposure), label (0 background, k), valid (1 = has a material and is
    finite), clipped.R/G/B, left_out (neither background nor a material), object (1-based, by its own mask; 0 unsaid).
    """
    facts = msgspec.convert(inputs.facts["dataset.photo"], PhotoSlice)
    materials = inputs.facts["dataset.materials"]
    name = inputs.photo
    progress(0, 3, f"{name}: photo")
    path = inputs.file(facts.image)
    photo = read_photo(path, facts.encoding, f"photos[{name}].image")
    progress(1, 3, f"{name}: masks")
    size = (photo.height, photo.width)
    labels = read_labels(facts.masks, inputs.file, materials, size, facts.image, f"photos[{name}].masks")
    objects = read_objects([(o.name, o.mask) for o in facts.objects], inputs.file, size, f"photos[{name}].objects")
    valid = _valid(photo, labels, path, f"photos[{name}].image")
    progress(2, 3, f"{name}: writing")
    write_exr(out / f"{name}.exr", _channels(photo, labels, valid, objects))
    write_json(out / f"{name}.json", _summary(photo, labels, valid, facts, materials))
    progress(3, 3, name)


def _valid(photo: Photo, labels: Labels, path: Path, key: str) -> np.ndarray:
    """Pixels of a material that are numbers, [h, w]; some that are not are told, all are refused."""
    inside = labels.label > 0
    lost = int((inside & ~photo.finite).sum())
    if lost == int(inside.sum()):
        raise InputError("every pixel in its mask is NaN or infinite", file=path, key=key, cure="render or develop the photo again")
    if lost:
        log.warning("%s: %d of the %d pixels in its mask are NaN or infinite: they are not used", path, lost, int(inside.sum()))
    return inside & photo.finite


def _channels(photo: Photo, labels: Labels, valid: np.ndarray, objects: np.ndarray) -> dict[str, np.ndarray]:
    colours = {c: photo.radiance[..., k] for k, c in enumerate("RGB")}
    clipped = {f"clipped.{c}": photo.clipped[..., k] for k, c in enumerate("RGB")}
    return {**colours, "label": labels.label, "valid": valid, "left_out": labels.left_out, "object": objects, **clipped}


def _summary(photo: Photo, labels: Labels, valid: np.ndarray, facts: PhotoSlice, materials: list[str]) -> dict:
    """`pixels` counts the valid ones of each material; `clipped_fraction` is the share of them clipped in any channel."""
    focal_px = facts.focal_px or photo.focal_px
    return {
        "width": photo.width,
        "height": photo.height,
        "focal_px": focal_px,
        "focal_source": "dataset" if facts.focal_px else "exif" if photo.focal_px else None,
        "encoding": photo.encoding,
        "illumination": facts.illumination,
        "pixels": {material: int((labels.label[valid] == k).sum()) for k, material in enumerate(materials, 1)},
        "clipped_fraction": float(photo.clipped[valid].any(axis=-1).mean()),
    }
