"""Material labels of a photo as one map, from any form of masks.

A mask has the photo's own pixels, as displayed. Ambiguous input raises InputError: another size, a label without a
material, two materials in one pixel, no labelled pixel at all.
"""

import logging
from collections.abc import Callable, Mapping
from math import prod
from pathlib import Path, PurePosixPath

import msgspec
import numpy as np
from jaxtyping import Bool, UInt8, UInt16
from numpy.lib.stride_tricks import sliding_window_view
from scipy import ndimage

from factorlib.dataset.paths import labelmap_beside
from factorlib.dataset.schema import LEFT_OUT
from factorlib.errors import InputError
from factorlib.labels.mask_files import read_coco, read_colours, read_inside, read_values

MUCH = 0.1  # share of an object's pixels that is more than a slip of the brush
DRAWN_EDGE = 2  # width of the pixels that adjacent outlines may share; they are left out without an error
SPECK_SHARE = 0.01  # area of a piece, as a share of the largest one's, below which it is a speck
SPECK_GAP = 0.1  # distance between pieces, in extents of the largest one, above which they are not of one thing
SPECK_CELLS = 512  # greatest number of cells along a side, on which pieces are sought
MOST_SPECKS = 5  # specks that are named with their places
log = logging.getLogger("factorlib.labels")


class Labels(msgspec.Struct, frozen=True):
    """Material labels of the pixels of a photo.

    label      0 background, k the k-th material; a material with several labels in dataset.yaml counts once
    left_out   True for pixels that are neither background nor a material, whose label is 0
    """

    label: UInt8[np.ndarray, "h w"]
    left_out: Bool[np.ndarray, "h w"]


def read_labels(
    masks: str | Mapping[str, str],
    file: Callable[[str], Path],
    materials: list[str],
    size: tuple[int, int],
    image: str,
    key: str = "masks",
) -> Labels:
    """Read the labels of one photo.

    Args:
        masks: A label PNG, a json of COCO or labelme, or {material: PNG}, as in dataset.yaml.
        file: Function from such a name to a path.
        materials: Material of each label, from 1; labels of one name are one material.
        size: Height and width of the photo as displayed.
        image: File name of the photo, for COCO.
        key: Key of `masks`, to name in errors.

    Returns:
        The labels.

    Raises:
        InputError: If the masks are invalid or empty.
    """
    mask_file = file(masks if isinstance(masks, str) else next(iter(masks.values())))
    names = list(dict.fromkeys(materials))
    if not isinstance(masks, str):
        places = {name: (file(masks[name]), f"{key}.{name}") for name in sorted(masks, key=names.index)}
        inside = {name: read_inside(*place, size) for name, place in places.items()}
        labels = _merged(inside, names, places, size, edge=0)
    elif masks.lower().endswith(".json"):
        inside = read_coco(mask_file, image, names, size, key)
        labels = _merged(inside, names, dict.fromkeys(inside, (mask_file, key)), size, edge=DRAWN_EDGE)
    else:
        folder = mask_file.parents[len(PurePosixPath(masks).parts) - 1]
        labelmap = labelmap_beside(masks, folder)
        values = read_colours(mask_file, folder / labelmap, materials, size, key) if labelmap else None
        values = read_values(mask_file, key, size) if values is None else values
        labels = _labels_of_png(values, mask_file, materials, key)
    if not labels.label.any():
        raise InputError(
            "the mask is empty: no pixel has a material",
            file=mask_file,
            key=key,
            cure="paint at least one material, or drop the photo",
        )
    return labels


def read_object_indices(
    masks: list[tuple[str, str | None]], file: Callable[[str], Path], size: tuple[int, int], key: str = "objects"
) -> UInt16[np.ndarray, "h w"]:
    """Read the index (from 1) of the object whose own mask covers each pixel, 0 for none.

    Args:
        masks: Name and PNG, or None, of each object.
        file: Function from such a name to a path.
        size: Height and width of the photo as displayed.
        key: Key of the objects, to name in errors.

    Returns:
        Indices.

    Raises:
        InputError: If a mask is invalid or empty, or if two masks overlap.
    """
    objects = np.zeros(size, dtype=np.uint16)
    for index, (name, path) in enumerate(masks):
        if path is None:
            continue
        mask_key = f"{key}[{index}].mask"
        inside = read_inside(file(path), mask_key, size)
        if not inside.any():
            raise InputError(
                f"the mask of object {name!r} is empty",
                file=file(path),
                key=mask_key,
                cure="paint it, or leave the key out",
            )
        if len(shared := objects[inside & (objects > 0)]):
            raise InputError(
                f"objects {masks[shared[0] - 1][0]!r} and {name!r} share {np.sum(shared == shared[0])} pixels",
                file=file(path),
                key=mask_key,
                cure="a pixel shows one object: erase it from the one behind",
            )
        objects[inside] = index + 1
    return objects


def check_materials(
    labels: Labels,
    objects: UInt16[np.ndarray, "h w"],
    object_materials: list[tuple[str, set[str]]],
    materials: list[str],
    path: Path,
    key: str = "objects",
) -> None:
    """Check that the materials in the mask are those of the objects.

    A wrong name shows as two faults at once: the mask has a material that no object has there, and lacks one that they
    have. Either alone is no contradiction, because a part may be hidden, and a mask may show things without a mesh.

    Args:
        labels: Labels of the photo.
        objects: Result of `read_object_indices`; objects without a mask of their own share the rest of the photo.
        object_materials: Name and materials of each object.
        materials: Materials of the dataset, in order.
        path: Path of the mask, to name in errors.
        key: Key of the objects, to name in errors.

    Raises:
        InputError: If both faults occur.
    """
    # number of pixels of each object (0: of none) and label, in the smallest type that holds both
    shape = len(object_materials) + 1, len(materials) + 1
    pairs = labels.label + objects * np.min_scalar_type(prod(shape)).type(shape[1])
    table = np.bincount(pairs.ravel(), minlength=prod(shape)).reshape(shape).tolist()
    groups = [([k], row) for k, row in enumerate(table[1:]) if any(row)]
    unmasked = [k for k, row in enumerate(table[1:]) if not any(row)]
    for members, (_, *row) in [*groups, (unmasked, table[0])]:
        counts = dict(zip(materials, row))
        expected = set().union(*(object_materials[k][1] for k in members))
        missing = [name for name in materials if name in expected and not counts[name]]
        most = max((name for name in materials if name not in expected), key=counts.__getitem__, default=None)
        if missing and most and counts[most] >= MUCH * sum(row) > 0:
            owners = ", ".join(repr(object_materials[k][0]) for k in members)
            raise InputError(
                f"the mask shows {most!r} in {counts[most] / sum(row):.0%} of the pixels of {owners}, "
                f"but no {missing[0]!r}",
                file=path,
                key=f"{key}[{members[0]}].materials",
                cure=f"correct the materials in dataset.yaml (there {', '.join(sorted(expected))}), "
                "or the labels of the mask",
            )


def describe_specks(inside: Bool[np.ndarray, "h w"]) -> str:
    """Name the small pieces of a mask that lie far from all others, with their places; "" for none."""
    # number of pixels of the mask in each cell, and the extent of the largest piece of touching cells
    cell = -(-max(inside.shape) // SPECK_CELLS)
    rows, columns = (np.arange(0, length, cell) for length in inside.shape)
    counts = np.add.reduceat(np.add.reduceat(inside, rows, axis=0, dtype=np.uint16), columns, axis=1, dtype=np.int64)
    pieces, _ = ndimage.label(counts, np.ones((3, 3)))
    largest = pieces == np.bincount(pieces.ravel(), counts.ravel()).argmax()
    reach = SPECK_GAP * (np.ptp(np.argwhere(largest), axis=0).max() + 1)
    # groups of pieces nearer to each other than SPECK_GAP extents; 0 is the background
    groups, _ = ndimage.label(ndimage.distance_transform_edt(counts == 0) <= reach / 2)
    areas = np.bincount(groups.ravel(), counts.ravel())
    specks = np.flatnonzero((areas < SPECK_SHARE * areas.max()) & (areas > 0))
    if not len(specks):
        return ""
    centres = np.multiply(ndimage.center_of_mass(counts, groups, specks), cell).round().astype(int).tolist()
    named = ", ".join(f"{areas[k]:.0f} px at ({x}, {y})" for k, (y, x) in zip(specks, centres[:MOST_SPECKS]))
    return f"specks far from the thing ({len(specks)}): {named}; erase what is no part of it"


def _labels_of_png(values: UInt16[np.ndarray, "h w"], path: Path, materials: list[str], key: str) -> Labels:
    """Convert the values of a label PNG to labels; InputError for an unknown value."""
    counts = np.bincount(values.ravel())
    present = set(np.flatnonzero(counts).tolist())
    if LEFT_OUT in present <= {0, LEFT_OUT}:
        cure = f"if 255 means inside, write masks: {{{materials[0]}: <this file>}}: in a label mask it means leave out"
        raise InputError("the mask is empty: it holds only 0 and 255", file=path, key=key, cure=cure)
    if unknown := present - {*range(len(materials) + 1), LEFT_OUT}:
        known = ", ".join(f"{k} {name}" for k, name in enumerate(materials, 1))
        raise InputError(
            f"unknown label {min(unknown)} ({counts[min(unknown)]} pixels)",
            file=path,
            key=key,
            cure=f"known are: 0 background, {known}, 255 leave out",
        )
    left_out = values == LEFT_OUT
    names = list(dict.fromkeys(materials))
    number = np.array([0, *(names.index(name) + 1 for name in materials)], np.uint8)
    return Labels(label=number[np.where(left_out, 0, values)], left_out=left_out)


def _merged(
    inside: Mapping[str, np.ndarray],
    materials: list[str],
    sources: Mapping[str, tuple[Path, str]],
    size: tuple[int, int],
    edge: int,
) -> Labels:
    """Merge masks of materials into one map.

    Pixels that two masks claim are left out; if they are wider than `edge` pixels, InputError is raised. Where outlines
    are drawn (`edge` > 0), a mask that lies wholly in another is in front of it.
    """
    label = np.zeros(size, dtype=np.uint8)
    left_out = label > 0
    numbers = [(k, name) for k, name in enumerate(materials, 1) if name in inside]
    for number, material in sorted(numbers, key=lambda each: -int(inside[each[1]].sum()) if edge else 0):
        path, key = sources[material]
        for claimed in np.unique(label[inside[material] & (label > 0)]).tolist():
            shared = inside[material] & (label == claimed)
            other_path = sources[materials[claimed - 1]][0]
            fault = f"materials {materials[claimed - 1]!r} and {material!r} share {int(shared.sum())} pixels"
            fault += f" with {other_path.name}" if other_path != path else ""
            within = (shared == inside[material]).all() and shared.sum() < inside[materials[claimed - 1]].sum()
            if edge and within:  # drawn on a larger one, whose outline does not spare it
                log.warning("%s: %s: %s: %r is in front", path, key, fault, material)
                continue
            if min(shared.shape) > edge and sliding_window_view(shared, (edge + 1, edge + 1)).all((2, 3)).any():
                raise InputError(
                    fault, file=path, key=key, cure="a pixel shows one material: erase it from the one behind"
                )
            log.warning("%s: %s: %s along their outlines: these are left out", path, key, fault)
            left_out |= shared
        label[inside[material]] = number
    label[left_out] = 0
    return Labels(label=label, left_out=left_out)
