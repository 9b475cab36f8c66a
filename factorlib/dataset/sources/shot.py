"""The common form of every source: one shot per image, its camera as COLMAP describes it."""

import json
import math
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import pycolmap

from factorlib.dataset.paths import Refusal
from factorlib.dataset.schema import CENTRE_PX, FOCAL_PX, LARGEST, Mat3, Pose, Vec2, Vec3
from factorlib.reading import read_text, reading
from factorlib.yamlfile import convert

SIDE_PX = 1e6  # most pixels of an image's width or height
MOST_OFF_PX = 0.5  # from a pinhole of one focal length, anywhere in the image
GRID = 33  # points a side at which the two are compared
MOST_BYTES = 256_000_000  # of a json; a scene of BOP has some 10 MB
DAMAGED = "the file is damaged: copy it again from where it came"


class Shot(msgspec.Struct, frozen=True):
    """An image of a source: its name or id, its camera, and the poses of what it shows.

    size            of the image in pixels, as in `schema.ExternalCamera`
    key             the place in the source, for messages
    centred         the source does not say where the principal point is
    cam_from_world  None where the source knows no world
    poses           obj_id -> cam_from_object of each instance, in millimetres
    """

    image: str | int
    camera: pycolmap.Camera
    size: tuple[float, float | None] | None
    key: str
    centred: bool = False
    cam_from_world: pycolmap.Rigid3d | None = None
    poses: dict[int, list[Pose]] = {}


def read_source(file: Path, type_: type, key: str | None = None) -> Any:
    """A json as a value of `type_`.  Raises InputError that names file and key."""
    text = read_text(file, "a JSON file", key, MOST_BYTES)
    with reading("JSON", file, key):
        return convert(json.loads(text), type_, file)


def colmap_camera(
    key: str, model: str, width: float, height: float, params: Sequence[float], refuse: Refusal
) -> pycolmap.Camera:
    """A camera of one of COLMAP's models; numbers that no camera has are refused, for pycolmap takes any."""
    fault = f"is no camera: {width:g}×{height:g} pixels, {model} {', '.join(f'{x:g}' for x in params)}"
    if not (1 <= width <= SIDE_PX and 1 <= height <= SIDE_PX):
        refuse(key, fault, f"an image is 1 to {SIDE_PX:g} pixels wide and high; {DAMAGED}")
    if not all(abs(x) <= LARGEST for x in params):
        refuse(key, fault, DAMAGED)
    return pycolmap.Camera(model=model, width=round(width), height=round(height), params=list(params))


def pinhole(camera: pycolmap.Camera, key: str, refuse: Refusal) -> tuple[float, Vec2]:
    """Focal length and principal point of the pinhole nearest to a camera: by least squares over its image.

    Pixels of the camera's image, centres at 0.5.  Refused where the two differ by more than MOST_OFF_PX somewhere.
    """
    centre = float(camera.principal_point_x), float(camera.principal_point_y)
    focals = camera.focal_length_x, camera.focal_length_y
    if not (min(camera.width, camera.height, *focals) > 0 and math.isfinite(sum(camera.params))):
        size = f"{camera.width}×{camera.height} pixels"
        refuse(key, f"is no camera: {size}, {camera.model_name} {camera.params_to_string()}", DAMAGED)
    if not (all(FOCAL_PX[0] <= f <= FOCAL_PX[1] for f in focals) and max(map(abs, centre)) <= CENTRE_PX):
        fault = f"a focal length of {focals[0]:g} px about ({centre[0]:g}, {centre[1]:g}) is no photo's"
        cure = f"focal lengths are {FOCAL_PX[0]:g} to {FOCAL_PX[1]:g} px, principal points up to {CENTRE_PX:g} px away"
        refuse(key, fault, f"{cure}; {DAMAGED}")
    if camera.is_undistorted() and focals[0] == focals[1]:
        return float(focals[0]), centre
    pixels = [[camera.width * i / (GRID - 1), camera.height * j / (GRID - 1)] for i in range(GRID) for j in range(GRID)]
    places = pixels - camera.calibration_matrix()[:2, 2]  # an array, as pycolmap's are
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # of pixels without a ray: the refusal below says so
        slopes = camera.cam_from_img(pixels)
        focal = float((slopes * places).sum() / (slopes * slopes).sum())
        off = float((((places - focal * slopes) ** 2).sum(axis=1) ** 0.5).max())
    if not off <= MOST_OFF_PX:  # NaN where a pixel has no ray
        far = f"by {off:.1f} px" if off == off else "so much that some pixels have no ray"
        how, cure = "the camera's lens distorts", "give the photo's camera.focal_px, principal_point and distortion: [k1, k2] in " \
            "dataset.yaml; or undistort by `colmap image_undistorter` and use its images, its model, and masks of them"  # fmt: skip
        if camera.is_undistorted():
            how, cure = "the camera's pixels are not square", "calibrate with one focal length (COLMAP's SIMPLE_PINHOLE or " \
                "SIMPLE_RADIAL), or resample photos and masks to square pixels"  # fmt: skip
        limit = f"up to {MOST_OFF_PX} px would not matter"
        refuse(key, f"{how}: it differs from a pinhole of one focal length {far}; {limit}", cure)
    return focal, centre


def rigid(rotation: Mat3, translation: Vec3) -> pycolmap.Rigid3d:
    """The rigid motion of a rotation matrix (made orthonormal) and a translation."""
    turn = pycolmap.Rotation3d(rotation)
    turn.normalize()
    return pycolmap.Rigid3d(turn, translation)


def as_rows(rotation: pycolmap.Rotation3d) -> Mat3:
    """The rotation as the rows of its matrix."""
    return tuple(tuple(map(float, row)) for row in rotation.matrix())
