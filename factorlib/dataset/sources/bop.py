"""A scene of a BOP data set (Hodaň et al. 2018): scene_camera.json and, where poses are public, scene_gt.json.

Its camera frame is OpenCV's; lengths are millimetres.  Its pixel centres are whole numbers (the toolkit turns pixel (0, 0)
of a depth map into the ray through (0, 0)), here they are at 0.5.  It does not say how large its images are.
"""

from __future__ import annotations

import re

import msgspec
import pycolmap

from factorlib.dataset.numbers import check_rotation
from factorlib.dataset.paths import Refusal, file_of
from factorlib.dataset.schema import Pose, Vec3
from factorlib.dataset.sources.shot import Shot, colmap_camera
from factorlib.dataset.sources.transforms import read_source
from factorlib.reading import one_line

KEY = "cameras.bop"
ID = re.compile("[0-9]{1,18}")
CAMERAS, POSES = "scene_camera.json", "scene_gt.json"
Nine = tuple[float, float, float, float, float, float, float, float, float]


class SceneCamera(msgspec.Struct, frozen=True):
    """cam_K: [[fx, s, cx], [0, fy, cy], [0, 0, 1]] row by row."""

    cam_K: Nine


class SceneObject(msgspec.Struct, frozen=True):
    """cam_from_object, millimetres."""

    obj_id: int
    cam_R_m2c: Nine
    cam_t_m2c: Vec3


def bop_shots(path: str, refuse: Refusal) -> list[Shot]:
    """The images of the scene in the dataset's folder `path`, by id."""
    camera_file, pose_file = (file_of(KEY, path, name, refuse) for name in (CAMERAS, POSES))
    if camera_file is None:
        refuse(KEY, f"there is no {CAMERAS} in {path!r}", "name the folder of one scene, such as test/000001")
    cameras = read_source(camera_file, dict[str, SceneCamera], KEY)
    poses = read_source(pose_file, dict[str, list[SceneObject]], KEY) if pose_file else {}
    of_cameras, of_poses = (Refusal(refuse.folder / path / name, refuse.folder) for name in (CAMERAS, POSES))
    for image in cameras:
        if not ID.fullmatch(image):
            of_cameras(one_line(image), "is not the id of an image", "ids are whole numbers, of 18 digits at most")
    return [
        Shot(
            int(image),
            _camera(image, camera, of_cameras),
            None,
            f"{CAMERAS}: {image}",
            poses=_poses(image, poses, of_poses),
        )
        for image, camera in sorted(cameras.items(), key=lambda item: int(item[0]))
    ]


def _camera(image: str, camera: SceneCamera, refuse: Refusal) -> pycolmap.Camera:
    """Its image is taken to be as large as twice the principal point."""
    fx, skew, cx, _, fy, cy, _, _, _ = camera.cam_K
    if skew != 0 or min(fx, fy, cx, cy) <= 0:
        cure = "give [fx, 0, cx, 0, fy, cy, 0, 0, 1] in pixels"
        refuse(f"{image}.cam_K", "is not the camera of square axes", cure)
    centre = cx + 0.5, cy + 0.5
    return colmap_camera(f"{image}.cam_K", "PINHOLE", 2 * centre[0], 2 * centre[1], [fx, fy, *centre], refuse)


def _poses(image: str, poses: dict[str, list[SceneObject]], refuse: Refusal) -> dict[int, list[Pose]]:
    result: dict[int, list[Pose]] = {}
    for index, obj in enumerate(poses.get(image, [])):
        rows = tuple(obj.cam_R_m2c[k : k + 3] for k in (0, 3, 6))
        check_rotation(f"{image}[{index}].cam_R_m2c", rows, refuse)
        result.setdefault(obj.obj_id, []).append(Pose(rows, obj.cam_t_m2c))
    return result
