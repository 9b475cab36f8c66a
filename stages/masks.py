"""Input of one photo and its masks: linear radiance, labels and usable pixels, averaged down to a useful size.

Writes <photo>.exr and <photo>.json.
"""

import logging
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np

from factorlib.dataset.schema import LEFT_OUT, PhotoSlice
from factorlib.errors import InputError
from factorlib.images.camera_files import is_raw
from factorlib.images.colours import count_colours
from factorlib.images.exr import write_exr
from factorlib.images.lens import Undistortion, radial_lens
from factorlib.images.photo import (
    OPAQUE,
    Photo,
    box_majority,
    box_sum,
    check_bright,
    decode_photo,
    least_factor,
    open_photo,
    read_alpha,
)
from factorlib.images.processing import reported_processing
from factorlib.images.scanlines import MOST_MEGAPIXELS, check_pixels
from factorlib.jsonfile import write_json
from factorlib.labels.label_image import Labels, read_labels, read_object_indices
from factorlib.results.photos import PhotoFacts
from factorlib.stage import Inputs, Progress, silent

log = logging.getLogger("factorlib.masks")
CURE = (
    "materials and lights take it for shading; use the raw file, or take it again with HDR, portrait and sharpening off"
)

SPLIT = "split it in `make label`, or let the texture hold the paint (docs/texture.md)"


class Params(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Limits on the size of a photo; a larger one is averaged down by the smallest sufficient integer factor."""

    pixels: Annotated[int, msgspec.Meta(ge=100)] = 1_000_000
    """Largest number of pixels with a material."""
    frame: Annotated[int, msgspec.Meta(ge=100)] = 4_000_000
    """Largest number of pixels of the whole photo."""
    most_megapixels: Annotated[float, msgspec.Meta(gt=0)] = MOST_MEGAPIXELS
    """Largest number of megapixels in the header of a photo's file; a larger file is refused unread."""


def main(params: Params, inputs: Inputs, out: Path, progress: Progress = silent) -> None:
    """Read a photo and its masks, and write `<photo>.exr` and `<photo>.json`.

    Channels of the EXR, float32:

    R, G, B         Linear Rec. 709 radiance, up to exposure.
    label           Number of the material, from 1; 0 for background.
    valid           1 for finite pixels with a material.
    clipped.R/G/B   1 for clipped values.
    left_out        1 for pixels that are neither background nor a material.
    object          Number of the object, from 1, where objects have masks of their own; else 0.
    alpha           Opacity, 0 to 1, of a cut-out; absent where all of the photo is opaque.
    """
    name = inputs.photo
    assert name is not None  # a stage over one photo
    facts = msgspec.convert(inputs.facts["dataset.photo"], PhotoSlice)
    materials = inputs.facts["dataset.materials"]
    path = inputs.file(facts.image)
    entry = f"photos[{name}]"
    opened = open_photo(path, f"{entry}.image")
    height, width = opened.size
    check_pixels(opened.size, params.most_megapixels, path, f"{entry}.image")
    progress(0, 3, f"{name}: masks")  # read first: they give the factor by which the photo is reduced while it is read
    labels = read_labels(facts.masks, inputs.file, facts.labels, opened.size, facts.image, f"{entry}.masks")
    object_masks = [(o.name, o.mask) for o in facts.objects]
    objects = read_object_indices(object_masks, inputs.file, opened.size, f"{entry}.objects")
    # smallest integer factor at which materials and frame fit their limits
    factor = least_factor(int(np.count_nonzero(labels.label)), params.pixels)
    factor = min(max(factor, least_factor(height * width, params.frame)), height, width)
    labels = reduce_labels(labels, factor, path, f"{entry}.masks")
    objects = box_majority(objects, factor)
    progress(1, 3, f"{name}: photo")
    photo = decode_photo(opened, facts.encoding, factor, path)
    planes = {"object": objects, **opacity(path, factor)}
    photo, labels, planes = undistort_photo(photo, labels, planes, facts, f"{entry}.camera.distortion")
    valid = valid_pixels(photo, labels, path, f"{entry}.image")
    if (processing := reported_processing(opened.exif)) and not is_raw(path):
        log.warning("%s: the camera processed it (%s): %s", path, processing, CURE)
    for number, material in enumerate(materials, 1):
        if count_colours(photo.radiance[valid & (labels.label == number) & ~photo.clipped.any(axis=-1)]) > 1:
            log.warning("%s: the mask of '%s' holds several colours: %s", path, material, SPLIT)
    progress(2, 3, f"{name}: writing")
    colours = {c: photo.radiance[..., k] for k, c in enumerate("RGB")}
    clipped = {f"clipped.{c}": photo.clipped[..., k] for k, c in enumerate("RGB")}
    channels = {"label": labels.label, "valid": valid, "left_out": labels.left_out, **planes}
    write_exr(out / f"{name}.exr", {**colours, **channels, **clipped})
    pixels = {material: int((labels.label[valid] == k).sum()) for k, material in enumerate(materials, 1)}
    write_json(out / f"{name}.json", photo_facts(photo, facts, (width, height), pixels, valid))
    progress(3, 3, name)


def photo_facts(
    photo: Photo, facts: PhotoSlice, original_size: tuple[int, int], pixels: dict[str, int], valid: np.ndarray
) -> PhotoFacts:
    """Return the facts about a photo that `masks` writes to its JSON file.

    Args:
        photo: The photo, as written.
        facts: The photo's keys in dataset.yaml.
        original_size: Width and height of the photo's file as displayed.
        pixels: Number of valid pixels by material.
        valid: Mask of valid pixels.
    """
    return PhotoFacts(
        width=photo.width,
        height=photo.height,
        factor=photo.factor,
        original_size=original_size,
        focal_px=facts.focal_px / photo.factor if facts.focal_px else photo.focal_px,
        focal_source="dataset" if facts.focal_px else "exif" if photo.focal_px else None,
        encoding=photo.encoding,
        exposure=photo.exposure,
        illumination=facts.illumination,
        pixels=pixels,
        clipped_fraction=float(photo.clipped[valid].any(axis=-1).mean()),
    )


def opacity(path: Path, factor: int) -> dict[str, np.ndarray]:
    """Return the channel `alpha` of a photo, averaged down, if some of its pixels are transparent."""
    alpha = read_alpha(path)
    return {} if alpha is None or alpha.min() == OPAQUE else {"alpha": box_sum(alpha, factor) / (OPAQUE * factor**2)}


def undistort_photo(
    photo: Photo, labels: Labels, planes: dict[str, np.ndarray], facts: PhotoSlice, key: str
) -> tuple[Photo, Labels, dict[str, np.ndarray]]:
    """Remove the distortion that dataset.yaml gives; InputError if it is not invertible within the picture."""
    lens = radial_lens(facts.camera, photo.factor, photo.width, photo.height)
    if lens is None:
        return photo, labels, planes
    lens.check(photo.width, photo.height, "dataset.yaml", key)
    pinhole = Undistortion(lens, photo.height, photo.width)
    labels = Labels(pinhole.resample_nearest(labels.label), pinhole.resample_nearest(labels.left_out) | ~pinhole.inside)
    return pinhole.photo(photo), labels, {name: pinhole.resample_nearest(plane) for name, plane in planes.items()}


def reduce_labels(labels: Labels, factor: int, path: Path, key: str) -> Labels:
    """Reduce labels by majority of each box; "left out" counts as a label.

    Raises:
        InputError: If no pixel of the result has a material.
    """
    if factor == 1:
        return labels
    label = box_majority(np.where(labels.left_out, np.uint8(LEFT_OUT), labels.label), factor)
    left_out = label == LEFT_OUT
    label[left_out] = 0
    if not label.any():
        raise InputError(
            f"averaged down {factor} × {factor}, no pixel shows mostly one material: the mask is made of specks",
            file=path,
            key=key,
            cure='allow more pixels, SET="masks.frame=…", or give a mask of whole objects',
        )
    return Labels(label, left_out)


def valid_pixels(photo: Photo, labels: Labels, path: Path, key: str) -> np.ndarray:
    """Return the mask [h, w] of finite pixels with a material, and warn of those that are not finite.

    Raises:
        InputError: If no pixel with a material is finite, or the photo is not bright enough.
    """
    inside = labels.label > 0
    total = int(inside.sum())
    lost = int((inside & ~photo.finite).sum())
    if lost == total:
        raise InputError(
            "every pixel in its mask is NaN or infinite", file=path, key=key, cure="render or develop the photo again"
        )
    check_bright(photo, inside, path, key)
    if lost:
        log.warning("%s: %d of the %d pixels in its mask are NaN or infinite: they are not used", path, lost, total)
    return inside & photo.finite
