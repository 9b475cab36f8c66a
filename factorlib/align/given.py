"""Checks of what is given for a photo against the photo: a pose puts its object before the camera, a camera fits the picture, and
every material of the mask is some object's."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence

import numpy as np
from jaxtyping import Float

from factorlib.errors import InputError
from factorlib.geometry.camera import Pose
from factorlib.meshes.mesh import Mesh

FIELD_DEG = 1.0, 150.0  # of view, across the longer side, that cameras have
log = logging.getLogger("factorlib.align")


def check_before_camera(mesh: Mesh, pose: Pose, photo: str, name: str, source: str = "dataset") -> None:
    """Of a pose that is used as it is: InputError where the object, or its middle, is not before the camera, z > 0; a warning
    where it reaches behind the camera, which then stands inside it.

    source: dataset, or the source of cameras that gives the pose
    """
    depth = pose.apply(mesh.vertices)[:, 2]
    middle = float(pose.apply(mesh.centre[None])[0, 2])
    key = f"photos[{photo}].objects[{name}].pose" if source == "dataset" else f"cameras.{source}: {photo}: {name}"
    if depth.max() <= 0 or middle <= 0:
        what = f"object {name!r}" if depth.max() <= 0 else f"the middle of object {name!r}"
        raise InputError(
            f"{what} is not before the camera: z = {middle:.4g}", file="dataset.yaml", key=key,
            cure="x_cam = R x_object + t with x right, y down, z forward (OpenGL's camera looks along −z: turn y and z over); "
            "take the object out of photos that do not show it",
        )  # fmt: skip
    behind = int(np.count_nonzero(depth <= 0))
    if behind:
        log.warning(
            "%s: %s: its pose (%s) puts %d of its %d vertices behind the camera, which then stands inside it: is it so, and in the "
            "mesh's units?", photo, name, source, behind, len(depth),
        )  # fmt: skip


def warn_of_materials(
    label: Float[np.ndarray, "h w"], of_objects: Iterable[Sequence[int]], materials: Sequence[str], photo: str
) -> None:
    """Of materials of the mask that no object of the photo has: their pixels get no normals and are not used.

    of_objects: labels of the materials of each object
    """
    shown, counts = np.unique(np.round(label[label > 0.5]).astype(int), return_counts=True)
    known = {int(k) for labels in of_objects for k in labels}
    for k, count in zip(shown.tolist(), counts.tolist()):
        if k not in known:
            log.warning(
                "%s: material %r has %d pixels in the mask, but no object of the photo has it: they are not used; is a label wrong, or "
                "is an object, or a part's material, missing in dataset.yaml?", photo, materials[k - 1], count,
            )  # fmt: skip


def warn_of_camera(focal: float | None, centre: tuple[float, float], size: tuple[int, int], photo: str) -> None:
    """Of a principal point outside the photo and of a field of view that is no camera's.  All in pixels; size: width, height."""
    width, height = size
    if not (0 <= centre[0] <= width and 0 <= centre[1] <= height):
        log.warning(
            "%s: its principal point (%.6g, %.6g) lies outside the photo of %d × %d pixels: so it is only where the photo is cut out of "
            "a larger one", photo, *centre, width, height,
        )  # fmt: skip
    if focal is not None:
        field = 2 * float(np.degrees(np.arctan(max(size) / 2 / focal)))
        if not FIELD_DEG[0] <= field <= FIELD_DEG[1]:
            log.warning(
                "%s: its focal length of %.6g px makes a field of view of %.4g°, which few cameras have: is it in pixels of the photo, "
                "not in millimetres?", photo, focal, field,
            )  # fmt: skip
