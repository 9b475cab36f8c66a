"""What a source of cameras says of each photo: its image found, its camera a pinhole, its poses in the meshes' units.

What dataset.yaml gives for a photo wins: a pose or keypoints of an object are not looked for in the source.
"""

from __future__ import annotations

import logging
from pathlib import Path, PurePosixPath

import msgspec

from factorlib.dataset.check import IMAGES
from factorlib.dataset.paths import Refusal
from factorlib.dataset.schema import SOURCES, CameraSource, DatasetFile, ExternalCamera, ObjectEntry, PhotoEntry, Pose
from factorlib.dataset.sources.bop import bop_shots
from factorlib.dataset.sources.colmap import colmap_shots
from factorlib.dataset.sources.shot import Shot, as_rows, pinhole, rigid
from factorlib.dataset.sources.transforms import transforms_shots
from factorlib.errors import did_you_mean

SUFFIXES = (*IMAGES, ".webp", ".bmp")  # what else follows a dot is part of a name: transforms.json may say "r_0.5"
READERS = {"colmap": colmap_shots, "transforms": transforms_shots, "bop": bop_shots}
log = logging.getLogger("factorlib.dataset")


def external_cameras(spec: DatasetFile, file: Path) -> tuple[DatasetFile, dict[str, ExternalCamera]]:
    """The dataset with world_from_camera filled in, where `cameras` asks for it, and what the source says of its photos.

    Photos that the source does not have are named in a warning.  Raises InputError, naming file, key and cure, for a source
    that cannot be read, a photo that could be several of its images, and a camera that is no pinhole of one focal length.
    """
    refuse = Refusal(file, file.parent)
    kind = next(kind for kind in SOURCES if getattr(spec.cameras, kind) is not None)
    shots = matched(spec, kind, READERS[kind](getattr(spec.cameras, kind), refuse), refuse)
    external = {
        photo.name: _external(kind, photo, shots[photo.name], spec.cameras, refuse)
        for photo in spec.photos
        if photo.name in shots
    }
    for name in [photo.name for photo in spec.photos if photo.name not in shots]:
        log.warning("%s: cameras.%s has no image of photo %r: it is aligned as if there were none; if it has one, name it: "
                    "cameras.images: {%s: …}", file, kind, name, name)  # fmt: skip
    if spec.cameras.world_from_camera:
        spec = msgspec.structs.replace(
            spec, photos=[_fixed_to_world(photo, shots.get(photo.name)) for photo in spec.photos]
        )
    return spec, external


def matched(spec: DatasetFile, kind: str, shots: list[Shot], refuse: Refusal) -> dict[str, Shot]:
    """photo -> its image in the source: as `images` says; else by path, by file name, or by that without suffix; BOP: by id."""
    by_name, named, result = {shot.image: shot for shot in shots}, _Named(shots), {}
    for photo in spec.photos:
        key = f"cameras.images.{photo.name}"
        if photo.name in spec.cameras.images:
            image = spec.cameras.images[photo.name]
            if image not in by_name:
                refuse(key, f"the source has no image {image!r}", did_you_mean(str(image), by_name))
            result[photo.name] = by_name[image]
            continue
        alike = named.alike(PurePosixPath(photo.image))
        if len(alike) > 1:
            names = ", ".join(repr(shot.image) for shot in alike[:3])
            refuse(key, f"{photo.image!r} could be {names}", f"say which: cameras.images: {{{photo.name}: …}}")
        if alike:
            result[photo.name] = alike[0]
    if not result:
        some = ", ".join(repr(shot.image) for shot in shots[:3]) or "none at all"
        cure = "say which is which: cameras.images: {photo: image, …}"
        refuse(f"cameras.{kind}", f"none of its {len(shots)} images ({some}) is named as a photo", cure)
    return result


class _Named:
    """Shots by everything that a photo's path may have in common with their names, so that a photo need not ask each."""

    def __init__(self, shots: list[Shot]):
        self.by_id, self.by_path, self.by_file, self.by_stem = ({} for _ in range(4))
        for shot in shots:
            path = PurePosixPath(str(shot.image).replace("\\", "/"))
            stem = path.stem if path.suffix.lower() in SUFFIXES else path.name
            for table, key in (
                (self.by_id, shot.image),
                (self.by_path, path.parts),
                (self.by_file, path.name),
                (self.by_stem, stem),
            ):
                table.setdefault(key, []).append(shot)

    def alike(self, photo: PurePosixPath) -> list[Shot]:
        """Those by the strictest way in which any is."""
        number = int(photo.stem) if photo.stem.isascii() and photo.stem.isdigit() else None
        tails = (photo.parts[-length:] for length in range(1, len(photo.parts) + 1))
        ways = (
            self.by_id.get(number, []),
            [shot for tail in tails for shot in self.by_path.get(tail, [])],
            self.by_file.get(photo.name, []),
            self.by_stem.get(photo.stem, []),
        )
        return next((found for found in ways if found), [])


def _external(kind: str, photo: PhotoEntry, shot: Shot, source: CameraSource, refuse: Refusal) -> ExternalCamera:
    poses, given = _poses(photo, shot, source, refuse), photo.camera
    if given is not None and given.focal_px is not None and given.principal_point is not None:
        return ExternalCamera(kind, given.focal_px, given.principal_point, None, poses)
    found = pinhole(shot.camera, shot.key, refuse)
    return ExternalCamera(kind, found.focal_px, None if shot.centred else found.principal_point, shot.size, poses)


def _poses(photo: PhotoEntry, shot: Shot, source: CameraSource, refuse: Refusal) -> dict[str, Pose]:
    """object -> pose, of those whose place the source gives and dataset.yaml does not."""
    objects = [obj for obj in photo.objects if obj.pose is None and not obj.keypoints]
    if source.bop is not None:
        found = {obj.name: _instance(photo, obj, shot, source, refuse) for obj in objects if obj.mesh in source.obj_ids}
        return {name: pose for name, pose in found.items() if pose is not None}
    placed = [obj.name for obj in objects if obj.name in source.world_from_object]
    scales = {source.world_from_object[name].scale for name in placed}
    if len(scales) > 1:
        found = f"photo {photo.name!r} shows objects of different scales, {', '.join(f'{scale:g}' for scale in sorted(scales))}"
        refuse("cameras.world_from_object", found, "objects of one photo share its unit: scale the meshes' files alike")
    return {name: _pose(name, shot, source) for name in placed}


def _pose(name: str, shot: Shot, source: CameraSource) -> Pose:
    """cam_from_object of scale 1: the camera's unit becomes the mesh's, which no picture shows."""
    similarity = source.world_from_object[name]
    cam_from_object = shot.cam_from_world * rigid(similarity.rotation, similarity.translation)
    return Pose(
        as_rows(cam_from_object.rotation), tuple(float(x) / similarity.scale for x in cam_from_object.translation)
    )


def _instance(photo: PhotoEntry, obj: ObjectEntry, shot: Shot, source: CameraSource, refuse: Refusal) -> Pose | None:
    """The one instance of the object's mesh, in units of the mesh; None, with a warning, where the scene names none."""
    obj_id = source.obj_ids[obj.mesh]
    poses = shot.poses.get(obj_id, [])
    if len(poses) > 1:
        found = f"image {shot.image} of photo {photo.name!r} shows obj_id {obj_id} {len(poses)} times"
        cure = f"give the pose of {obj.name!r} in photos: cam_R_m2c and cam_t_m2c of its instance"
        refuse(f"cameras.obj_ids.{obj.mesh}", found, cure)
    if not poses:
        log.warning("%s: cameras.bop knows no obj_id %d in image %s: the pose of %s in %s is searched",
                    refuse.file, obj_id, shot.image, obj.name, photo.name)  # fmt: skip
        return None
    return Pose(poses[0].rotation, tuple(x / source.mesh_unit_mm for x in poses[0].translation))


def _fixed_to_world(photo: PhotoEntry, shot: Shot | None) -> PhotoEntry:
    if photo.world_from_camera is not None or shot is None:
        return photo
    return msgspec.structs.replace(photo, world_from_camera=as_rows(shot.cam_from_world.inverse().rotation))
