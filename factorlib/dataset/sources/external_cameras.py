"""Cameras of photos from an external source.

Images are matched, cameras are reduced to pinholes, and poses are converted to mesh units.  Values in dataset.yaml take
precedence: an object with a pose or keypoints there gets no pose from the source.
"""

import logging
import math
from collections.abc import Iterable, Mapping
from pathlib import Path

import msgspec
import pycolmap

from factorlib.dataset.check import IMAGES
from factorlib.dataset.paths import Refusal, plain_path
from factorlib.dataset.schema import (
    SOURCES,
    CameraSource,
    DatasetFile,
    ExternalCamera,
    MeshEntry,
    PhotoEntry,
    RigidTransform,
    Similarity,
    Vec3,
)
from factorlib.dataset.sources.colmap import read_colmap
from factorlib.dataset.sources.json_sources import read_bop, read_transforms
from factorlib.dataset.sources.source_image import (
    SourceImage,
    as_rows,
    pinhole,
    rigid_motion,
)
from factorlib.errors import did_you_mean

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
