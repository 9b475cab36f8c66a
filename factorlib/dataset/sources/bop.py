"""Reading of a scene of a BOP data set (Hodaň et al. 2018): scene_camera.json and scene_gt.json, if poses are public.

Its camera frame is OpenCV's, and lengths are millimetres.  Its pixel centres are whole numbers: the toolkit turns pixel
(0, 0) of a depth map into the ray through (0, 0).  Here they are at 0.5.  It does not state the size of its images.
"""

from typing import Annotated

import msgspec

from factorlib.dataset.paths import Refusal
from factorlib.dataset.schema import Number, RigidTransform, Vec3
from factorlib.dataset.sources.source_image import SourceImage, colmap_camera, read_source

KEY = "cameras.bop"
CAMERAS = "scene_camera.json"
POSES = "scene_gt.json"
IDS = "it is not the id of an image: ids are whole numbers, of 18 digits at most"
ImageId = Annotated[str, msgspec.Meta(pattern=r"^[0-9]{1,18}\Z", description=IDS)]
Nine = tuple[Number, Number, Number, Number, Number, Number, Number, Number, Number]


class SceneCamera(msgspec.Struct, frozen=True):
    """Camera of an image; cam_K is [[fx, s, cx], [0, fy, cy], [0, 0, 1]], row by row."""

    cam_K: Nine


class SceneObject(msgspec.Struct, frozen=True):
    """An instance of an object with its cam_from_object, in millimetres."""

    obj_id: int
    cam_R_m2c: Nine
    cam_t_m2c: Vec3


def read_bop(path: str, refuse: Refusal) -> list[SourceImage]:
    """Read the images of the scene in the dataset's folder `path`, sorted by id.

    The size of an image is assumed to be twice its principal point.
    """
    camera_file, pose_file = (refuse.file_in(KEY, path, name) for name in (CAMERAS, POSES))
    if camera_file is None:
        refuse(KEY, f"there is no {CAMERAS} in {path!r}", "name the folder of one scene, such as test/000001")
    cameras = read_source(camera_file, dict[ImageId, SceneCamera], KEY)
    poses = read_source(pose_file, dict[str, list[SceneObject]], KEY) if pose_file else {}
    camera_refusal, pose_refusal = (Refusal(refuse.folder / path / name, refuse.folder) for name in (CAMERAS, POSES))
    images = []
    for image, camera in sorted(cameras.items(), key=lambda item: int(item[0])):
        fx, skew, cx, _, fy, cy, _, _, _ = camera.cam_K
        camera_refusal.when(
            skew != 0 or min(fx, fy, cx, cy) <= 0,
            f"{image}.cam_K",
            "is not the camera of square axes",
            "give [fx, 0, cx, 0, fy, cy, 0, 0, 1] in pixels",
        )
        # pixel centres from whole numbers to 0.5
        size = (2 * cx + 1, 2 * cy + 1)
        params = [fx, fy, cx + 0.5, cy + 0.5]
        pinhole = colmap_camera(f"{image}.cam_K", "PINHOLE", *size, params, camera_refusal)
        instances: dict[int, list[RigidTransform]] = {}
        for index, obj in enumerate(poses.get(image, [])):
            rows = tuple(obj.cam_R_m2c[k : k + 3] for k in (0, 3, 6))
            pose_refusal.rotation(f"{image}[{index}].cam_R_m2c", rows)
            instances.setdefault(obj.obj_id, []).append(RigidTransform(rows, obj.cam_t_m2c))
        images.append(SourceImage(int(image), pinhole, None, f"{CAMERAS}: {image}", poses=instances))
    return images
