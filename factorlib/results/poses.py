"""poses.json of `align`: camera and object poses by photo, with measures of confidence.

`align` writes the entry of one photo as <photo>.json; poses.json collects them.
"""

from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np

from factorlib.errors import InputError
from factorlib.geometry.camera import Camera, Pose, is_pose
from factorlib.jsonfile import read_result
from factorlib.results.materials import Vec3, vec3

FILE = "poses.json"

Positive = Annotated[float, msgspec.Meta(gt=0)]


class PoseEntry(msgspec.Struct, frozen=True):
    """The pose cam_from_object: x_cam = rotation · x_object + translation."""

    rotation: tuple[Vec3, Vec3, Vec3]
    translation: Vec3

    @property
    def pose(self) -> Pose:
        """The pose cam_from_object as arrays."""
        return Pose(np.array(self.rotation), np.array(self.translation))


class RunnerUpPose(PoseEntry, frozen=True):
    """The runner-up: the best pose that differs clearly from the chosen one.

    Attributes:
        score: labelled IoU
        normal_difference_deg: angle between its normals and those of the best pose, degrees
    """

    score: float
    normal_difference_deg: float


class ObjectPose(PoseEntry, frozen=True):
    """An object's pose and its measures of confidence (`factorlib.align.reliability`); None for what was not measured.

    Attributes:
        source: origin of the pose: found, keypoints, or who gave it
        doubts: reasons against the pose, in words
        left_out: True if the solve leaves the object out because of them
    """

    silhouette_iou: float | None = None
    label_agreement: float | None = None
    source: str | None = None
    score: float | None = None
    runner_up: RunnerUpPose | None = None
    contour_error: float | None = None
    normal_stderr_deg: float | None = None
    doubts: list[str] = []
    left_out: bool = False


class CameraEntry(msgspec.Struct, frozen=True):
    """The camera in pixels of <photo>.exr of `masks`, each of which covers factor² of the photo's.

    Attributes:
        focal_px: focal length
        principal_point: (x, y), pixel centres at 0.5
        focal_source: dataset, colmap, transforms, bop, sfm, exif or estimated
        focal_relative_stderr: standard error of the logarithm of the focal length
        factor: factor by which `masks` reduced the photo
    """

    focal_px: Positive
    principal_point: tuple[float, float]
    focal_source: str = "estimated"
    focal_relative_stderr: Annotated[float, msgspec.Meta(ge=0)] = 0.0
    factor: Annotated[int, msgspec.Meta(ge=1)] = 1

    def camera(self, width: int, height: int) -> Camera:
        """Return the camera of a picture of `width` × `height` pixels."""
        return Camera(width, height, self.focal_px, self.principal_point)


class PhotoPoses(msgspec.Struct, frozen=True):
    """Camera and object poses of one photo."""

    camera: CameraEntry
    objects: dict[str, ObjectPose]

    @property
    def left_out(self) -> list[str]:
        """Names of the objects that the solve leaves out."""
        return [name for name, pose in self.objects.items() if pose.left_out]


def pose_fields(pose: Pose) -> dict[str, Any]:
    """Return a pose as the fields of a `PoseEntry`."""
    return {"rotation": tuple(map(vec3, pose.rotation)), "translation": vec3(pose.translation)}


def read_poses(path: str | Path) -> dict[str, PhotoPoses]:
    """Read poses.json: poses by photo; InputError if the file has another form."""
    photos = read_result(path, dict[str, PhotoPoses], "align")
    for name, photo in photos.items():
        _check(photo, path, f"{name}.objects")
    return photos


def read_photo_poses(path: str | Path) -> PhotoPoses:
    """Read the poses of one photo as `align` writes them; InputError if the file has another form."""
    photo = read_result(path, PhotoPoses, "align")
    _check(photo, path, "objects")
    return photo


def _check(photo: PhotoPoses, path: str | Path, key: str) -> None:
    for name, obj in photo.objects.items():
        for entry in (obj, obj.runner_up):
            if entry is not None and not is_pose(np.array(entry.rotation), np.array(entry.translation)):
                raise InputError(
                    "the pose is invalid: its rotation is not a rotation matrix, or a number is not finite",
                    file=path,
                    key=f"{key}.{name}",
                    cure="run the stage `align` again",
                )
