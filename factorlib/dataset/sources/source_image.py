"""Common form of every source of cameras: each of its images, with a camera in COLMAP's terms."""

import json
import math
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import pycolmap

from factorlib.dataset.paths import Refusal
from factorlib.dataset.schema import CENTRE_PX, FOCAL_PX, LARGEST, Mat3, RigidTransform, Vec2, Vec3
from factorlib.reading import read_text, reading
from factorlib.yamlfile import convert

SIDE_PX = 1e6  # largest width or height of an image, pixels
MOST_OFF_PX = 0.5  # largest distance from a pinhole of one focal length, anywhere in the image
GRID = 33  # points per side at which the two are compared
MOST_BYTES = 256_000_000  # largest size of a JSON file; a scene of BOP has some 10 MB
DAMAGED = "the file is damaged: copy it again from its source"


class SourceImage(msgspec.Struct, frozen=True):
    """An image of a source, with its camera and the poses of objects.

    Attributes:
        name: name or id
        size: size of the image in pixels, as in `schema.ExternalCamera`
        key: place in the source, for messages
        centred: True if the source does not give the principal point
        focal_known: False if the source does not give the focal length
        cam_from_world: None if the source has no world, or not this image's pose
        posed: False if the source does not give the pose
        poses: cam_from_object of each instance by obj_id, in millimetres
    """

    name: str | int
    camera: pycolmap.Camera
    size: tuple[float, float | None] | None
    key: str
    centred: bool = False
    focal_known: bool = True
    cam_from_world: pycolmap.Rigid3d | None = None
    poses: dict[int, list[RigidTransform]] = {}
    posed: bool = True


def read_source(file: Path, type_: type, key: str | None = None) -> Any:
    """Read a JSON file as a value of a type.

    Args:
        file: the file
        type_: the type
        key: the key in dataset.yaml, for errors

    Raises:
        InputError: The file does not hold such a value; the error names file and key.
    """
    with reading("JSON", file, key):
        return convert(json.loads(read_text(file, "a JSON file", key, MOST_BYTES)), type_, file)


def colmap_camera(
    key: str, model: str, width: float, height: float, params: Sequence[float], refuse: Refusal
) -> pycolmap.Camera:
    """Return a camera of one of COLMAP's models.

    pycolmap accepts any numbers, so implausible ones are rejected here.

    Args:
        key: place in the source, for errors
        model: name of the camera model
        width: width in pixels
        height: height in pixels
        params: parameters of the model
        refuse: raises errors
    """
    fault = f"is not a camera: {width:g}×{height:g} pixels, {model} {', '.join(f'{x:g}' for x in params)}"
    refuse.refuse_if(
        not (1 <= width <= SIDE_PX and 1 <= height <= SIDE_PX),
        key,
        fault,
        f"an image is 1 to {SIDE_PX:g} pixels wide and high; {DAMAGED}",
    )
    refuse.refuse_if(not all(abs(x) <= LARGEST for x in params), key, fault, DAMAGED)
    return pycolmap.Camera(model=model, width=round(width), height=round(height), params=list(params))


def pinhole(camera: pycolmap.Camera, key: str, refuse: Refusal) -> tuple[float, Vec2]:
    """Return focal length and principal point of the pinhole nearest to a camera, by least squares over its image.

    Args:
        camera: the camera; pixel centres at 0.5
        key: place in the source, for errors
        refuse: raises an error if the two differ by more than MOST_OFF_PX anywhere
    """
    centre = float(camera.principal_point_x), float(camera.principal_point_y)
    focals = camera.focal_length_x, camera.focal_length_y
    refuse.refuse_if(
        not (min(camera.width, camera.height, *focals) > 0 and math.isfinite(sum(camera.params))),
        key,
        f"is not a camera: {camera.width}×{camera.height} pixels, {camera.model_name} {camera.params_to_string()}",
        DAMAGED,
    )
    refuse.refuse_if(
        not (all(FOCAL_PX[0] <= f <= FOCAL_PX[1] for f in focals) and max(map(abs, centre)) <= CENTRE_PX),
        key,
        f"its focal length {focals[0]:g} px or principal point ({centre[0]:g}, {centre[1]:g}) is implausible",
        f"focal lengths are {FOCAL_PX[0]:g} to {FOCAL_PX[1]:g} px, principal points up to {CENTRE_PX:g} px; {DAMAGED}",
    )
    undistorted = camera.is_undistorted() and "FISHEYE" not in camera.model_name  # no pinhole even with zeros
    if undistorted and focals[0] == focals[1]:
        return float(focals[0]), centre
    pixels = [[camera.width * i / (GRID - 1), camera.height * j / (GRID - 1)] for i in range(GRID) for j in range(GRID)]
    places = pixels - camera.calibration_matrix()[:2, 2]  # an array, as pycolmap's are
    with warnings.catch_warnings(action="ignore", category=RuntimeWarning):  # of pixels without a ray, rejected below
        # least-squares focal length of pixel offset over slope, and the largest residual
        slopes = camera.cam_from_img(pixels)
        assert slopes is not None  # as of a single point; rows of many points are NaN
        focal = float((slopes * places).sum() / (slopes * slopes).sum())
        error = float((((places - focal * slopes) ** 2).sum(axis=1) ** 0.5).max())
    extent = f"by {error:.1f} px" if error == error else "so much that some pixels have no ray"
    cause = "pixels are not square" if undistorted else "lens distorts"
    refuse.refuse_if(
        not error <= MOST_OFF_PX,  # NaN where a pixel has no ray
        key,
        f"the camera's {cause}: it differs from a pinhole of one focal length {extent} (allowed: {MOST_OFF_PX} px)",
        "calibrate with one focal length (COLMAP's SIMPLE_PINHOLE or SIMPLE_RADIAL), "
        "or resample photos and masks to square pixels"
        if undistorted
        else "give the photo's camera.focal_px, principal_point and distortion: [k1, k2] in dataset.yaml; "
        "or undistort by `colmap image_undistorter` and use its images, its model, and masks of them",
    )
    return focal, centre


def rigid_motion(rotation: Mat3, translation: Vec3) -> pycolmap.Rigid3d:
    """Return the rigid motion of a rotation matrix (made orthonormal) and a translation."""
    turn = pycolmap.Rotation3d(rotation)
    turn.normalize()
    return pycolmap.Rigid3d(turn, translation)


def as_rows(rotation: pycolmap.Rotation3d) -> Mat3:
    """Return the rows of a rotation's matrix."""
    x, y, z = ((float(a), float(b), float(c)) for a, b, c in rotation.matrix())
    return x, y, z
