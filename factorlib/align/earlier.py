"""Poses of an earlier result, by photo and object: poses.json of a folder that `align`, `fit_mesh` or `refine` wrote."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
from jaxtyping import Float

from factorlib.align.camera import Pose
from factorlib.align.place import Earlier, EarlierFocal
from factorlib.errors import InputError
from factorlib.jsonfile import read_json

FILE = "poses.json"
Vec3 = tuple[float, float, float]
POSITIVE = Annotated[float, msgspec.Meta(gt=0)]
Factors = tuple[POSITIVE, POSITIVE, POSITIVE]
SEARCHED = ("found", "keypoints", "refined")  # sources of poses that may still move; others were given
ROTATION_ERROR = 1e-3  # of RᵀR from the identity


class EarlierPose(msgspec.Struct, frozen=True):
    """cam_from_object."""

    rotation: tuple[Vec3, Vec3, Vec3]
    translation: Vec3

    def pose(self) -> Pose:
        return Pose(np.array(self.rotation), np.array(self.translation))


class EarlierRunnerUp(EarlierPose, frozen=True):
    """How well it fits, and how far its normals are from those of the pose found."""

    score: float
    normal_difference_deg: float


class EarlierObject(EarlierPose, frozen=True):
    """What is used of an object's entry; x_cam = rotation · (scale ∘ x_object) + translation."""

    scale: Factors = (1.0, 1.0, 1.0)
    runner_up: EarlierRunnerUp | None = None

    def as_found(self) -> Earlier:
        other = self.runner_up
        return Earlier(self.pose(), other.pose(), other.score, other.normal_difference_deg) if other else Earlier(self.pose())


class EarlierCamera(msgspec.Struct, frozen=True):
    """focal_px: in pixels that stand for factor² of the photo's."""

    focal_px: POSITIVE
    focal_source: str = "estimated"
    focal_relative_stderr: Annotated[float, msgspec.Meta(ge=0)] = 0.0
    factor: Annotated[int, msgspec.Meta(ge=1)] = 1


class EarlierPhoto(msgspec.Struct, frozen=True):
    """What is used of a photo's entry."""

    camera: EarlierCamera
    objects: dict[str, EarlierObject]

    def focal(self, factor: int) -> EarlierFocal:
        """In pixels of the photo averaged down by `factor`, which may have been another one then."""
        camera = self.camera
        return EarlierFocal(camera.focal_px * (camera.factor / factor), camera.focal_source, camera.focal_relative_stderr)


def read_earlier(folder: Path) -> dict[str, EarlierPhoto]:
    """By photo.  Raises InputError for a file that holds no poses."""
    path = folder / FILE
    try:
        photos = msgspec.convert(read_json(path), dict[str, EarlierPhoto])
    except msgspec.ValidationError as error:
        raise _unfit(path, str(error)) from None
    for photo, entry in photos.items():
        for name, thing in entry.objects.items():
            for pose in (thing, thing.runner_up):
                if pose is not None and not is_pose(np.array(pose.rotation), np.array(pose.translation)):
                    raise _unfit(path, "a pose that is no rotation and translation", f"{photo}.objects.{name}")
    return photos


def is_pose(rotation: Float[np.ndarray, "3 3"], translation: Float[np.ndarray, "3"]) -> bool:
    """Finite, and a rotation to within rounding.

    >>> is_pose(np.diag([1.0, 1.0, -1.0]), np.ones(3))
    False
    """
    finite = np.isfinite(rotation).all() and np.isfinite(translation).all()
    return bool(finite and np.abs(rotation.T @ rotation - np.eye(3)).max() < ROTATION_ERROR and np.linalg.det(rotation) > 0)


def _unfit(path: Path, found: str, key: str | None = None) -> InputError:
    return InputError(f"no poses to start from: {found}", file=path, key=key, cure="name the folder of a result of `align`, `fit_mesh` or `refine`")
