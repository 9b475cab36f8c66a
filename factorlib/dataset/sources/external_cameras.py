"""Cameras of photos from an external source.

Images are matched, cameras are reduced to pinholes, and poses are converted to mesh units.  Values in dataset.yaml take
precedence: an object with a pose or keypoints there gets no pose from the source.
"""

import logging
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated

import msgspec
import pycolmap

from factorlib.dataset.check import IMAGES
from factorlib.dataset.paths import Refusal, plain_path
from factorlib.dataset.schema import (
    FOCAL_PX,
    SOURCES,
    CameraSource,
    Centre,
    DatasetFile,
    ExternalCamera,
    Focal,
    MeshEntry,
    Number,
    PhotoEntry,
    RigidTransform,
    Similarity,
    Vec3,
)
from factorlib.dataset.sources.colmap import read_colmap
from factorlib.dataset.sources.source_image import (
    SIDE_PX,
    SourceImage,
    as_rows,
    colmap_camera,
    pinhole,
    read_source,
    rigid_motion,
)
from factorlib.errors import did_you_mean
from factorlib.reading import one_line

# Reading of cameras from JSON: a NeRF-style transforms.json, and a scene of a BOP data set.
#
# transforms.json is as nerfstudio, instant-ngp and NeRF's own scenes have it. Its cameras are OpenGL's (x right, y up,
# z backward), and its matrices are world_from_camera.
#
# A BOP scene (Hodaň et al. 2018) has scene_camera.json and, if poses are public, scene_gt.json. Its camera frame is
# OpenCV's, and lengths are millimetres. Its pixel centres are whole numbers: the toolkit turns pixel (0, 0) of a depth
# map into the ray through (0, 0). Here they are at 0.5. It does not state the size of its images.

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


SUFFIXES = (*IMAGES, ".webp", ".bmp")  # Other suffixes are part of a name: transforms.json may say "r_0.5".
READERS = {"colmap": read_colmap, "transforms": read_transforms, "bop": read_bop}
# Standard deviations of photos that people take, in radians: roll about the view, and height of the view.
ROLL, TILT = math.radians(3), math.radians(30)
log = logging.getLogger("factorlib.dataset")


def external_cameras(spec: DatasetFile, file: Path) -> tuple[DatasetFile, dict[str, ExternalCamera]]:
    """Read the cameras of a dataset's photos from its external source, the key `cameras` of dataset.yaml.

    `file` is the path of dataset.yaml.  The cameras are returned by photo, and the dataset with world_from_camera of
    the source if `cameras` asks for it.  A warning names photos that the source lacks.

    Raises:
        InputError: The source cannot be read, a photo matches several of its images, or a camera is not a pinhole.
    """
    refuse = Refusal(file, file.parent)
    source = spec.cameras
    assert source is not None  # the reader asks only for a source of files
    external = {}
    photos = []
    kind = next(kind for kind in SOURCES if getattr(source, kind) is not None)
    paths = {photo.name: photo.image for photo in spec.photos}
    images = match_images(paths, source.images, kind, READERS[kind](getattr(source, kind), refuse), refuse)
    for photo in spec.photos:
        image = images.get(photo.name)
        if image is None:
            log.warning(
                "%s: cameras.%s has no image of photo %r: it is aligned as if there were none; "
                "if it has one, name it: cameras.images: {%s: …}",
                file,
                kind,
                photo.name,
                photo.name,
            )
        elif image.posed:
            poses = _poses(photo, image, source, spec.meshes, refuse)
            intrinsics = photo.camera
            if intrinsics is not None and intrinsics.focal_px is not None and intrinsics.principal_point is not None:
                external[photo.name] = ExternalCamera(
                    kind, intrinsics.focal_px, intrinsics.principal_point, None, poses
                )
            else:
                focal, centre = pinhole(image.camera, image.key, refuse)
                known = focal if image.focal_known else None
                external[photo.name] = ExternalCamera(kind, known, None if image.centred else centre, image.size, poses)
        photos.append(photo)
    if source.world_from_camera:
        photos = fix_to_upright_world(photos, images, source.up)
    return msgspec.structs.replace(spec, photos=photos), external


def fix_to_upright_world(
    photos: list[PhotoEntry], images: Mapping[str, SourceImage], up: str | None
) -> list[PhotoEntry]:
    """Return the photos with world_from_camera of the source, in its world turned so that −y points up.

    A photo that has its own stays as it is, and the world is not turned then.

    Args:
        photos: photos of the dataset
        images: image of the source by photo
        up: axis of the source's world that points up; None: that of the cameras' common horizon
    """
    rotations = {
        name: image.cam_from_world.inverse().rotation
        for name, image in images.items()
        if image.posed and image.cam_from_world is not None  # bop, which has no world, does not ask for it
    }
    turn = pycolmap.Rotation3d()
    if not any(photo.world_from_camera for photo in photos):
        turn = upright_turn(list(rotations.values()), up)
    return [
        msgspec.structs.replace(photo, world_from_camera=as_rows(turn * rotations[photo.name]))
        if photo.name in rotations and photo.world_from_camera is None
        else photo
        for photo in photos
    ]


def upright_turn(rotations: list[pycolmap.Rotation3d], up: str | None = None) -> pycolmap.Rotation3d:
    """Return the smallest turn of a world after which −y points up, as in a camera that is held level.

    Photos are held level: their horizontal axes a_k are at right angles to the upright u, which the cameras' own
    upright axes b_k follow loosely.  u minimises Σ (a_k·u)²/ROLL² + Σ |u − b_k|²/TILT².

    Args:
        rotations: world_from_camera of the photos
        up: axis of the world that points up; None: u
    """
    if up:
        upright = [(-1.0 if up[0] == "-" else 1.0) * (axis == up[-1]) for axis in "xyz"]
    else:
        # (Σ a aᵀ/ROLL² + n/TILT²) u = Σ b/TILT², by Cramer's rule
        matrix = [[len(rotations) / TILT**2 * (i == k) for i in range(3)] for k in range(3)]
        right = [0.0] * 3
        for rotation in rotations:
            across, below = as_rows(rotation.inverse())[:2]  # rows of the inverse are the camera's axes in the world
            for i in range(3):
                right[i] -= below[i] / TILT**2
                for k in range(3):
                    matrix[i][k] += across[i] * across[k] / ROLL**2
        crosses = [cross(matrix[1], matrix[2]), cross(matrix[2], matrix[0]), cross(matrix[0], matrix[1])]
        upright = [sum(right[k] * crosses[k][i] for k in range(3)) for i in range(3)]  # times the determinant
    length = max(math.hypot(*upright), 1e-300)
    axis = cross([value / length for value in upright], [0.0, -1.0, 0.0])
    sine = math.hypot(*axis)
    if sine < 1e-9:  # upright or upside down
        axis, sine = [1.0, 0.0, 0.0], 1.0
        angle = math.pi * (upright[1] > 0)
    else:
        angle = math.atan2(sine, -upright[1] / length)
    return pycolmap.Rotation3d([angle / sine * value for value in axis])


def cross(a: list[float], b: list[float]) -> list[float]:
    """Return the cross product; without NumPy, which a run with nothing to do does not load."""
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def match_images(
    paths: Mapping[str, str], chosen: Mapping[str, str | int], kind: str, images: list[SourceImage], refuse: Refusal
) -> dict[str, SourceImage]:
    """Return the image of the source, with its pose or without, for each photo that has one.

    The match is by choice, else by path, by file name, or by file name without suffix; for BOP it is by id.

    Args:
        paths: path of each photo
        chosen: names of images by photo, the key `cameras.images`
        kind: kind of the source
        images: images of the source
        refuse: raises errors
    """
    by_name = {image.name: image for image in images} | {str(plain_path(str(i.name))): i for i in images}
    by_pattern: dict[tuple, list[SourceImage]] = {}  # images by each name that may match a photo's
    for image in images:
        path = plain_path(str(image.name))
        stem = path.stem if path.suffix.lower() in SUFFIXES else path.name
        for pattern in (("id", image.name), ("path", *path.parts), ("file", path.name), ("stem", stem)):
            by_pattern.setdefault(pattern, []).append(image)
    result = {}
    for photo, place in paths.items():
        key = f"cameras.images.{photo}"
        if photo in chosen:
            name = chosen[photo] if chosen[photo] in by_name else str(plain_path(str(chosen[photo])))
            cure = did_you_mean(str(name), by_name)
            refuse.refuse_if(name not in by_name, key, f"the source has no image {name!r}", cure)
            result[photo] = by_name[name]
            continue
        matches = ([image for pattern in each for image in by_pattern.get(pattern, [])] for each in _patterns(place))
        candidates = next(filter(None, matches), [])
        fault = f"{place!r} matches several images of the source: {', '.join(repr(i.name) for i in candidates[:3])}"
        refuse.refuse_if(len(candidates) > 1, key, fault, f"choose one: cameras.images: {{{photo}: …}}")
        if candidates:
            result[photo] = candidates[0]
    examples = ", ".join(repr(image.name) for image in images[:3]) or "none at all"
    refuse.refuse_if(
        not any(image.posed for image in result.values()),
        f"cameras.{kind}",
        f"none of its {len(images)} images ({examples}) with a pose has the name of a photo",
        "assign images to photos: cameras.images: {photo: image, …}",
    )
    return result


def _patterns(photo: str) -> list[list[tuple]]:
    """Return the names under which a photo may stand in a source, the strictest first."""
    path = plain_path(photo)
    number = int(path.stem) if path.stem.isascii() and path.stem.isdigit() else None
    tails: list[tuple] = [("path", *path.parts[-length:]) for length in range(1, len(path.parts) + 1)]
    return [[("id", number)], tails, [("file", path.name)], [("stem", path.stem)]]


def _poses(
    photo: PhotoEntry, image: SourceImage, source: CameraSource, meshes: Mapping[str, MeshEntry], refuse: Refusal
) -> dict[str, RigidTransform]:
    """Return poses by object, for objects that the source places and dataset.yaml does not.

    Hulls are in the source's frame unless it says otherwise.
    """
    objects = [obj for obj in photo.objects if obj.pose is None and not obj.keypoints]
    poses = {}
    if source.bop is not None:  # pose of the one instance of the object's mesh, in units of the mesh
        for obj in (obj for obj in objects if obj.mesh in source.obj_ids):
            obj_id = source.obj_ids[obj.mesh]
            instances = image.poses.get(obj_id, [])
            refuse.refuse_if(
                len(instances) > 1,
                f"cameras.obj_ids.{obj.mesh}",
                f"image {image.name} of photo {photo.name!r} shows obj_id {obj_id} {len(instances)} times",
                f"give the pose of {obj.name!r} in photos: cam_R_m2c and cam_t_m2c of its instance",
            )
            if not instances:
                log.warning(
                    "%s: cameras.bop has no obj_id %d in image %s: the pose of %s in %s is searched by its mask",
                    refuse.file,
                    obj_id,
                    image.name,
                    obj.name,
                    photo.name,
                )
            for pose in instances:
                poses[obj.name] = RigidTransform(pose.rotation, _divide(pose.translation, source.mesh_unit_mm))
        return poses
    similarities = {obj.name: Similarity() for obj in objects if meshes[obj.mesh].hull} | source.world_from_object
    placed = {obj.name: similarities[obj.name] for obj in objects if obj.name in similarities}
    scales = sorted({similarity.scale for similarity in placed.values()})
    refuse.refuse_if(
        len(scales) > 1,
        "cameras.world_from_object",
        f"photo {photo.name!r} has objects of different scales, {', '.join(f'{s:g}' for s in scales)}",
        "scale the mesh files so that a photo's objects have one scale",
    )
    for name, similarity in placed.items():  # The mesh's unit replaces the source's, which changes no picture.
        assert image.cam_from_world is not None  # only bop has no world
        cam_from_object = image.cam_from_world * rigid_motion(similarity.rotation, similarity.translation)
        translation = _divide(cam_from_object.translation, similarity.scale)
        poses[name] = RigidTransform(as_rows(cam_from_object.rotation), translation)
    return poses


def _divide(vector: Iterable[float], unit: float) -> Vec3:
    """Return a vector in another unit."""
    x, y, z = (float(value) / unit for value in vector)
    return x, y, z
