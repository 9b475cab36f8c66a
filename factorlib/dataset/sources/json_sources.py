"""Reading of cameras from JSON: a NeRF-style transforms.json, and a scene of a BOP data set.

transforms.json is as nerfstudio, instant-ngp and NeRF's own scenes have it. Its cameras are OpenGL's (x right, y up,
z backward), and its matrices are world_from_camera.

A BOP scene (Hodaň et al. 2018) has scene_camera.json and, if poses are public, scene_gt.json. Its camera frame is
OpenCV's, and lengths are millimetres. Its pixel centres are whole numbers: the toolkit turns pixel (0, 0) of a depth
map into the ray through (0, 0). Here they are at 0.5. It does not state the size of its images.
"""

import logging
import math
from typing import Annotated

import msgspec
import pycolmap

from factorlib.dataset.paths import Refusal
from factorlib.dataset.schema import FOCAL_PX, Centre, Focal, Number, RigidTransform, Vec3
from factorlib.dataset.sources.source_image import SIDE_PX, SourceImage, colmap_camera, read_source, rigid_motion
from factorlib.reading import one_line

FISHEYE = "OPENCV_FISHEYE"
PERSPECTIVE = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")
ANY_WIDTH = 1000.0  # assumed width of an image with only a known field of view
Side = Annotated[float, msgspec.Meta(ge=1, le=SIDE_PX, description="an image has 1 to 1e+06 pixels a side")]
KEY = "cameras.bop"
CAMERAS = "scene_camera.json"
POSES = "scene_gt.json"
ImageId = Annotated[
    str,
    msgspec.Meta(
        pattern=r"^[0-9]{1,18}\Z",
        description="it is not the id of an image: ids are whole numbers, of 18 digits at most",
    ),
]
Nine = tuple[Number, Number, Number, Number, Number, Number, Number, Number, Number]
log = logging.getLogger("factorlib.dataset")


class FrameCamera(msgspec.Struct, frozen=True):
    """Intrinsics that all frames share, or those of one frame, in pixels with centres at 0.5."""

    camera_model: str | None = None
    is_fisheye: bool | None = None
    camera_angle_x: Number | None = None
    fl_x: Focal | None = None
    fl_y: Focal | None = None
    cx: Centre | None = None
    cy: Centre | None = None
    w: Side | None = None
    h: Side | None = None
    k1: Number | None = None
    k2: Number | None = None
    k3: Number | None = None
    k4: Number | None = None
    p1: Number | None = None
    p2: Number | None = None


class Frame(FrameCamera, frozen=True, kw_only=True):
    """An image and its camera; transform_matrix is world_from_camera in OpenGL's axes, with 3 or 4 rows, if known."""

    file_path: str
    transform_matrix: list[tuple[Number, Number, Number, Number]] | None = None


class TransformsFile(FrameCamera, frozen=True, kw_only=True):
    """Content of transforms.json: the lens that its frames share, and the frames."""

    frames: list[Frame]


def read_transforms(path: str, refuse: Refusal) -> list[SourceImage]:
    """Read the frames of the dataset's file `path`, in its order; a frame's own lens overrides the file's.

    A warning names frames without a pose.
    """
    file = refuse.folder / path
    content = read_source(file, TransformsFile)
    refuse = Refusal(file, refuse.folder)
    images = []
    for index, frame in enumerate(content.frames):
        key = f"frames[{index}]"
        pairs = ((name, getattr(frame, name), getattr(content, name)) for name in FrameCamera.__struct_fields__)
        lens = FrameCamera(**{name: shared if own is None else own for name, own, shared in pairs})
        camera, size = _camera(key, lens, refuse)
        matrix_key = f"{key}.transform_matrix"
        if (rows := frame.transform_matrix) is None:
            log.warning("%s: %s: %s has no transform_matrix: its camera is not known", file, key, frame.file_path)
            images.append(SourceImage(frame.file_path, camera, size, key, posed=False))
            continue
        refuse.refuse_if(
            len(rows) not in (3, 4) or (len(rows) == 4 and tuple(rows[3]) != (0, 0, 0, 1)),
            matrix_key,
            "is not a rigid matrix",
            "give the rows [R | t], and [0, 0, 0, 1] below them or nothing",
        )
        refuse.check_rotation(matrix_key, tuple(row[:3] for row in rows[:3]))
        right, down, forward = ((x, -y, -z) for x, y, z, _ in rows[:3])  # OpenGL's camera axes to OpenCV's
        image = SourceImage(
            name=frame.file_path,
            camera=camera,
            size=size,
            key=f"{file.name}: {key}",
            centred=lens.cx is None or lens.cy is None,
            focal_known=lens.fl_x is not None or lens.camera_angle_x is not None,
            cam_from_world=rigid_motion((right, down, forward), (rows[0][3], rows[1][3], rows[2][3])).inverse(),
        )
        images.append(image)
    refuse.refuse_if(
        not any(image.posed for image in images),
        "frames",
        "none has a transform_matrix",
        "register the photos, or remove this file",
    )
    return images


def _camera(key: str, lens: FrameCamera, refuse: Refusal) -> tuple[pycolmap.Camera, tuple[float, float | None] | None]:
    """Return the camera with the size of its image.

    Without `w`, a field of view gives the focal length of an image of width ANY_WIDTH.
    """
    angle = lens.camera_angle_x
    focal = ANY_WIDTH if lens.fl_x is None and angle is None else lens.fl_x  # the former stands for an unknown one
    if focal is None:
        assert angle is not None
        focal = (lens.w or ANY_WIDTH) / 2 / math.tan(angle / 2) if 0 < angle < math.pi else math.nan
        refuse.refuse_if(
            not FOCAL_PX[0] <= focal <= FOCAL_PX[1],
            f"{key}.camera_angle_x",
            f"an angle of {angle:g} is not a field of view",
            "give it in radians, more than 0 and less than π",
        )
        if lens.w is None:
            camera = colmap_camera(key, "SIMPLE_PINHOLE", ANY_WIDTH, 1, [focal, ANY_WIDTH / 2, 0.5], refuse)
            return camera, (ANY_WIDTH, None)
    size = (lens.w, lens.h) if lens.w is not None and lens.h is not None else None
    width, height = size or (2 * max(lens.cx or focal, 1.0), 2 * max(lens.cy or focal, 1.0))
    pinhole = [
        focal,
        focal if lens.fl_y is None else lens.fl_y,
        width / 2 if lens.cx is None else lens.cx,
        height / 2 if lens.cy is None else lens.cy,
    ]
    k1, k2, k3, k4, p1, p2 = (value or 0.0 for value in (lens.k1, lens.k2, lens.k3, lens.k4, lens.p1, lens.p2))
    is_perspective = lens.camera_model in (None, *PERSPECTIVE)
    if not any((k1, k2, k3, k4, p1, p2)) and not lens.is_fisheye and is_perspective:
        model = "PINHOLE"
        params = pinhole
    elif lens.is_fisheye or lens.camera_model == FISHEYE:
        model = FISHEYE
        params = [*pinhole, k1, k2, k3, k4]
    elif is_perspective and k4 == 0:
        model = "FULL_OPENCV"
        params = [*pinhole, k1, k2, p1, p2, k3, 0, 0, 0]
    else:
        fault = f"the camera model {one_line(repr(lens.camera_model))} with k4 = {k4} is not read here"
        refuse(f"{key}.camera_model", fault, f"undistort the photos, or give {', '.join((*PERSPECTIVE, FISHEYE))}")
    return colmap_camera(key, model, min(width, SIDE_PX), min(height, SIDE_PX), params, refuse), size


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
        camera_refusal.refuse_if(
            skew != 0 or min(fx, fy, cx, cy) <= 0,
            f"{image}.cam_K",
            "has a skew, or a focal length or principal point that is not positive",
            "give [fx, 0, cx, 0, fy, cy, 0, 0, 1] in pixels",
        )
        # pixel centres from whole numbers to 0.5
        params = [fx, fy, cx + 0.5, cy + 0.5]
        pinhole = colmap_camera(f"{image}.cam_K", "PINHOLE", 2 * cx + 1, 2 * cy + 1, params, camera_refusal)
        instances: dict[int, list[RigidTransform]] = {}
        for index, obj in enumerate(poses.get(image, [])):
            rows = tuple(obj.cam_R_m2c[k : k + 3] for k in (0, 3, 6))
            pose_refusal.check_rotation(f"{image}[{index}].cam_R_m2c", rows)
            instances.setdefault(obj.obj_id, []).append(RigidTransform(rows, obj.cam_t_m2c))
        images.append(SourceImage(int(image), pinhole, None, f"{CAMERAS}: {image}", poses=instances))
    return images
