"""What every source is read to: one shot per image, its camera as COLMAP describes it."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence

import msgspec
import pycolmap

from factorlib.dataset.numbers import CENTRE_PX, FOCAL_PX, LARGEST, SIDE_PX
from factorlib.dataset.paths import Refusal
from factorlib.dataset.schema import Mat3, Pose, Vec2, Vec3

MOST_OFF_PX = 0.5  # from a pinhole of one focal length, anywhere in the image
GRID = 33  # points a side at which the two are compared
DAMAGED = "the file is damaged: copy it again from where it came"


class Shot(msgspec.Struct, frozen=True):
    """An image of a source: its name or id, its camera, and what it shows from where.

    size            of the image in pixels, as in `schema.ExternalCamera`
    centred         the source does not say where the principal point is
    cam_from_world  None where the source knows no world
    poses           obj_id -> cam_from_object of each instance, in millimetres
    key             where the source says so, for messages
    """

    image: str | int
    camera: pycolmap.Camera
    size: tuple[float, float | None] | None
    key: str
    centred: bool = False
    cam_from_world: pycolmap.Rigid3d | None = None
    poses: dict[int, list[Pose]] = {}


class Pinhole(msgspec.Struct, frozen=True):
    """A camera without distortion; pixels, centres at 0.5."""

    focal_px: float
    principal_point: Vec2


def colmap_camera(
    key: str, model: str, width: float, height: float, params: Sequence[float], refuse: Refusal
) -> pycolmap.Camera:
    """A camera of one of COLMAP's models; what could be none is refused, for pycolmap takes any number."""
    said = f"{width:g}×{height:g} pixels, {model} {', '.join(f'{x:g}' for x in params)}"
    if not (1 <= width <= SIDE_PX and 1 <= height <= SIDE_PX):
        refuse(key, f"is no camera: {said}", f"an image is 1 to {SIDE_PX:g} pixels wide and high; {DAMAGED}")
    if not all(abs(x) <= LARGEST for x in params):
        refuse(key, f"is no camera: {said}", DAMAGED)
    return pycolmap.Camera(model=model, width=round(width), height=round(height), params=list(params))


def turned(key: str, quaternion: Sequence[float], translation: Sequence[float], refuse: Refusal) -> pycolmap.Rigid3d:
    """A rigid motion of a quaternion x y z w, of whatever length but 0."""
    length = math.hypot(*quaternion)
    if not (0 < length <= LARGEST and all(abs(x) <= LARGEST for x in translation)):
        refuse(key, "is no pose: its numbers are zero, not finite or too large", DAMAGED)
    return pycolmap.Rigid3d(pycolmap.Rotation3d([x / length for x in quaternion]), list(translation))


def pinhole(camera: pycolmap.Camera, key: str, refuse: Refusal) -> Pinhole:
    """The pinhole of one focal length nearest to a camera, about its principal point: least squares over the image.

    Pixels of the camera's image, centres at 0.5.  Refused where the two differ by more than MOST_OFF_PX somewhere.
    """
    centre = float(camera.principal_point_x), float(camera.principal_point_y)
    focals = camera.focal_length_x, camera.focal_length_y
    if not (min(camera.width, camera.height, *focals) > 0 and math.isfinite(sum(camera.params))):
        fault = f"is no camera: {camera.width}×{camera.height} pixels, {camera.model_name} {camera.params_to_string()}"
        refuse(key, fault, DAMAGED)
    if not (all(FOCAL_PX[0] <= f <= FOCAL_PX[1] for f in focals) and max(map(abs, centre)) <= CENTRE_PX):
        found = f"a focal length of {focals[0]:g} px about ({centre[0]:g}, {centre[1]:g}) is no photo's"
        refuse(
            key,
            found,
            f"a focal length is {FOCAL_PX[0]:g} to {FOCAL_PX[1]:g} px, a principal point at most {CENTRE_PX:g} px away; {DAMAGED}",
        )
    if camera.is_undistorted() and focals[0] == focals[1]:
        return Pinhole(float(focals[0]), centre)
    pixels = [[camera.width * i / (GRID - 1), camera.height * j / (GRID - 1)] for i in range(GRID) for j in range(GRID)]
    places = pixels - camera.calibration_matrix()[:2, 2]  # an array, as pycolmap's are
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # of pixels without a ray: the refusal below says so
        slopes = camera.cam_from_img(pixels)
        focal = float((slopes * places).sum() / (slopes * slopes).sum())
        off = float((((places - focal * slopes) ** 2).sum(axis=1) ** 0.5).max())
    if not off <= MOST_OFF_PX:  # NaN where a pixel has no ray
        refuse(key, _unlike(camera, off), _cure(camera))
    return Pinhole(focal, centre)


def _unlike(camera: pycolmap.Camera, off: float) -> str:
    how = "the camera's pixels are not square" if camera.is_undistorted() else "the camera's lens distorts"
    far = f"by {off:.1f} px" if off == off else "so much that some pixels have no ray"
    return f"{how}: it differs from a pinhole of one focal length {far}; up to {MOST_OFF_PX} px would not matter"


def _cure(camera: pycolmap.Camera) -> str:
    if camera.is_undistorted():
        return "calibrate with one focal length (COLMAP's SIMPLE_PINHOLE or SIMPLE_RADIAL), or resample photos and masks to square pixels"
    return "undistort by `colmap image_undistorter` and use its images and its model; masks belong to the undistorted images"


def rigid(rotation: Mat3, translation: Vec3) -> pycolmap.Rigid3d:
    """cam_from_world of a rotation matrix (made orthonormal) and a translation."""
    turn = pycolmap.Rotation3d(rotation)
    turn.normalize()
    return pycolmap.Rigid3d(turn, translation)


def as_rows(rotation: pycolmap.Rotation3d) -> Mat3:
    """The rotation as the rows of its matrix."""
    return tuple(tuple(map(float, row)) for row in rotation.matrix())
