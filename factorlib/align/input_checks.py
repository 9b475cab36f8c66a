"""Checks of poses and cameras that are given for a photo.

A pose must put its object in front of the camera. A camera must fit the picture, also a camera from an external source
(COLMAP, transforms.json, BOP). Every material of the mask must belong to some object.
"""

import logging
from collections.abc import Iterable, Sequence

import numpy as np
from jaxtyping import Float

from factorlib.align.photo_alignment import KnownFocal
from factorlib.dataset.schema import ExternalCamera, ObjectsSlice, Vec2
from factorlib.errors import InputError
from factorlib.geometry.camera import Camera, Pose
from factorlib.meshes.mesh import Mesh
from factorlib.results.photos import PhotoFacts

FIELD_DEG = 1.0, 150.0  # range of cameras' fields of view across the longer side, degrees
MOST_ROUNDED_PX = 1.0  # greatest rounding of a resized picture's side, which is a whole number
INNER = 0.25, 0.75  # range of a principal point, as a share of the photo's side
log = logging.getLogger("factorlib.align")


def check_before_camera(mesh: Mesh, pose: Pose, photo: str, name: str, source: str = "dataset") -> None:
    """Check that a given pose puts the object in front of the camera (z > 0).

    A warning is logged if the object reaches behind the camera, which then stands inside it.

    Args:
        mesh: Mesh of the object.
        pose: Given pose.
        photo: Name of the photo.
        name: Name of the object.
        source: "dataset", or the source of cameras that gives the pose.

    Raises:
        InputError: If all vertices, or the mesh's centre, are behind the camera.
    """
    depth = pose.apply(mesh.vertices)[:, 2]
    middle = float(pose.apply(mesh.centre[None])[0, 2])
    if depth.max() <= 0 or middle <= 0:
        subject = f"object {name!r}" if depth.max() <= 0 else f"the middle of object {name!r}"
        raise InputError(
            f"{subject} is behind the camera: z = {middle:.4g}",
            file="dataset.yaml",
            key=f"photos[{photo}].objects[{name}].pose"
            if source == "dataset"
            else f"cameras.{source}: {photo}: {name}",
            cure="correct the pose, x_cam = R x_object + t with x right, y down, z forward (negate y and z of an "
            "OpenGL camera, which looks along −z), or remove the object from this photo",
        )
    if behind_count := int(np.count_nonzero(depth <= 0)):
        log.warning(
            "%s: %s: its pose (%s) puts %d of its %d vertices behind the camera, as if this stood inside the "
            "object: check the pose, and that its translation is in the mesh's units",
            photo,
            name,
            source,
            behind_count,
            len(depth),
        )


def warn_of_materials(
    label: Float[np.ndarray, "h w"], object_labels: Iterable[Sequence[int]], materials: Sequence[str], photo: str
) -> None:
    """Warn of materials of the mask that no object of the photo has; their pixels get no normals and are not used.

    Args:
        label: Label of each pixel; k stands for `materials[k - 1]`, 0 for background.
        object_labels: Labels of the materials of each object.
        materials: Names of all materials.
        photo: Name of the photo.
    """
    labels, counts = np.unique(np.round(label[label > 0.5]).astype(int), return_counts=True)
    known = {int(k) for each in object_labels for k in each}
    for k, count in zip(labels.tolist(), counts.tolist()):
        if k not in known:
            log.warning(
                "%s: material %r has %d pixels in the mask, but no object of the photo has it, so they are not used: "
                "correct the label in the mask, or add the object, or the material of its part, in dataset.yaml",
                photo,
                materials[k - 1],
                count,
            )


def warn_of_camera(focal: float | None, centre: tuple[float, float], size: tuple[int, int], photo: str) -> None:
    """Warn of a principal point outside the photo and of an implausible field of view.

    Args:
        focal: Focal length in pixels; None if it is unknown.
        centre: Principal point (x, y) in pixels.
        size: Width and height in pixels.
        photo: Name of the photo.
    """
    width, height = size
    if not (0 <= centre[0] <= width and 0 <= centre[1] <= height):
        log.warning(
            "%s: its principal point (%.6g, %.6g) lies outside the photo of %d × %d pixels, as only in a photo "
            "cropped from a larger one: check that it is in pixels of this photo",
            photo,
            *centre,
            width,
            height,
        )
    if focal is not None:
        field = 2 * float(np.degrees(np.arctan(max(size) / 2 / focal)))
        if not FIELD_DEG[0] <= field <= FIELD_DEG[1]:
            log.warning(
                "%s: its focal length of %.6g px makes a field of view of %.4g°, which few cameras have: check "
                "that it is in pixels of the photo, not in millimetres",
                photo,
                focal,
                field,
            )


def convert_intrinsics(external: ExternalCamera, width: int, height: int, photo: str) -> tuple[float | None, Vec2]:
    """Convert focal length and principal point of an external source's image to pixels of the photo, as displayed.

    Args:
        external: Camera of the external source.
        width: Width of the photo as displayed.
        height: Height of the photo as displayed.
        photo: Name of the photo.

    Returns:
        Focal length, None if the source does not give it, and principal point (x, y).

    Raises:
        InputError: If the photo is not the image at another size, but was cropped, rotated or squeezed.
    """
    size = external.size
    point = external.principal_point
    fault = cure = None
    # photo pixels per image pixel across and down: equal but for the rounding of the photo's shorter side
    across = down = 1.0 if size is None else width / size[0]
    if size is not None and size[1] is not None:
        down = height / size[1]
        fault, cure = _compare_sizes((size[0], size[1]), (width, height))
    centre = (width / 2, height / 2) if point is None else (point[0] * across, point[1] * down)
    if size is None and not all(INNER[0] * side <= c <= INNER[1] * side for side, c in zip((width, height), centre)):
        position = f"({centre[0]:.0f}, {centre[1]:.0f}) is far from the middle of the photo's {width}×{height} pixels"
        fault = f"its principal point {position}"
        cure = (
            "give the photo at the size that the source was made of, or its camera in dataset.yaml (camera, and pose "
            "of its objects)"
        )
    if fault:
        raise InputError(fault, file="dataset.yaml", key=f"cameras.{external.source}: {photo}", cure=cure)
    scale = across if width >= height else down
    return None if external.focal_px is None else external.focal_px * scale, centre


def _compare_sizes(image: tuple[float, float], photo: tuple[int, int]) -> tuple[str | None, str | None]:
    """Return fault and cure if a photo cannot be an image at another size, by width and height; else None twice."""

    def is_resized(size: tuple[float, float]) -> bool:
        """Return whether the ratio of the longer sides gives the shorter one to within a pixel."""
        (long, short), (longer, shorter) = (size, photo) if photo[0] >= photo[1] else (size[::-1], photo[::-1])
        return abs(short * longer / long - shorter) <= MOST_ROUNDED_PX

    if is_resized(image):
        return None, None
    sizes = f"the photo has {photo[0]}×{photo[1]} pixels, its image in the source {image[0]:g}×{image[1]:g}"
    if is_resized(image[::-1]):
        return (
            f"{sizes}: it was made of the photo before its EXIF orientation was applied",
            "turn the photo's own pixels upright (ImageMagick: mogrify -auto-orient) and make the source of those",
        )
    return f"{sizes}: it was cropped or squeezed", "give the image itself, or the same at another size, and masks of it"


def camera_of_photo(slice_: ObjectsSlice, facts: PhotoFacts, photo: str) -> tuple[Camera, KnownFocal]:
    """Return the photo's camera without its focal length, and the prior knowledge of the focal length.

    dataset.yaml takes precedence over the dataset's source of cameras, which takes precedence over EXIF and the photo's
    centre. The first two are in pixels of the photo's file; the stage `masks` reduced several of these to one pixel.

    Args:
        slice_: Entries of dataset.yaml that the photo needs.
        facts: Size, scale factor and focal length of the photo.
        photo: Name of the photo.

    Returns:
        The camera with a focal length of 1, and the known focal length.
    """
    factor = facts.factor
    (width, height) = facts.original_size
    focal = facts.focal_px
    source = facts.focal_source
    centre = (width / 2, height / 2)
    if slice_.external is not None and (source != "dataset" or slice_.camera.principal_point is None):
        external_focal, centre = convert_intrinsics(slice_.external, width, height, photo)
        if source != "dataset" and external_focal is not None:
            focal = external_focal / factor
            source = slice_.external.source
    across, down = slice_.camera.principal_point or centre
    return Camera(facts.width, facts.height, 1.0, (across / factor, down / factor)), KnownFocal(focal, source)
