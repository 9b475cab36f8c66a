"""Where the meshes are in each photo, and what every pixel sees of them: normals, view directions, depth, labels."""

import logging
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np

from factorlib.align.confidence import confidence
from factorlib.align.doubts import Standards, doubts
from factorlib.align.earlier import earlier_focal, earlier_pose
from factorlib.align.external_camera import focal_and_centre
from factorlib.align.given import check_before_camera, warn_of_camera, warn_of_materials
from factorlib.align.keypoints import Keypoints
from factorlib.align.overlay import overlay
from factorlib.align.place import KnownFocal, ObjectToPlace, Placed, placed
from factorlib.align.search import Found, Search
from factorlib.align.silhouette import label_agreement, silhouette_iou, silhouette_of_object, silhouette_of_photo
from factorlib.align.trust import trust_in
from factorlib.dataset import schema
from factorlib.errors import InputError
from factorlib.geometry.camera import Camera, Pose
from factorlib.geometry.raster import Caster, Maps, rasterise
from factorlib.images.exr import read_exr, write_exr
from factorlib.images.picture import write_png
from factorlib.meshes.limits import Limits
from factorlib.meshes.mesh import Mesh, scaled
from factorlib.meshes.read import CREASE_DEG, read_mesh
from factorlib.results.photos import PhotoFacts, read_photo_facts
from factorlib.results.poses import (
    AS_IT_IS,
    FILE,
    CameraEntry,
    ObjectEntry,
    PhotoPoses,
    RunnerUp,
    entry_of,
    read_poses,
    write_photo_poses,
)
from factorlib.stage import Inputs, Progress

log = logging.getLogger("factorlib.align")
CURE = "look at its overlay; give the object's keypoints or pose, or the photo's camera.focal_px, in dataset.yaml"
CURE_OF_EXTERNAL = (
    "look at its overlay; does the source show this photo, and is the mesh where world_from_object or obj_ids say?"
)


class Params(Standards, frozen=True, forbid_unknown_fields=True):
    """How meshes are read and poses searched, and what follows from a doubtful pose."""

    crease_deg: Annotated[float, msgspec.Meta(gt=0, le=180)] = CREASE_DEG
    """Angle, in degrees, between the normals of two triangles above which the edge between them stays sharp."""
    strict: bool = False
    """Whether a doubtful pose stops the run."""
    keep_doubtful: bool = False
    """Whether an object whose pose was found, and is doubtful, takes part in the solve."""
    limits: Limits = Limits()
    search: Search = Search()


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Align the meshes of one photo and write its maps, its poses and the overlay."""
    name = inputs.photo
    slice_ = msgspec.convert(inputs.facts["dataset.objects"], schema.ObjectsSlice)
    channels, facts = read_exr(inputs["masks"] / f"{name}.exr"), read_photo_facts(inputs["masks"] / f"{name}.json")
    earlier = read_poses(inputs["poses"] / FILE).get(name) if "poses" in inputs.folders else None
    objects = objects_of(slice_, channels, inputs, params, facts.factor, earlier)
    camera, known = camera_of(slice_, facts, name)
    check_given_poses(slice_, objects, name)
    warn_of_materials(
        channels["label"], [each.caster.mesh.labels for each in objects], inputs.facts["dataset.materials"], name
    )
    warn_of_camera(known.focal, camera.centre, (camera.width, camera.height), name)
    before = earlier_focal(earlier.camera, facts.factor) if earlier else None
    result = placed(objects, camera, known, name, params.search, before)
    maps = rasterise([each.caster for each in objects], result.camera, result.poses)
    whole = silhouette_of_photo(channels)
    write_png(out / f"{name}_overlay.png", overlay(np.stack([channels[c] for c in "RGB"], axis=-1), maps, whole))
    external = slice_.external.source if slice_.external else None
    sources = {obj.name: "given" if obj.pose else external for obj in slice_.objects}
    entries = {each.name: entry(each, k, result, maps, params, sources[each.name]) for k, each in enumerate(objects)}
    for object_name, found in entries.items():
        complain(name, object_name, found, params.strict)
    left_out = np.isin(maps.object, [k for k, found in enumerate(entries.values(), start=1) if found.left_out])
    write_maps(out / f"{name}.exr", maps, np.where(left_out, 0.0, confidence(maps, whole)))
    write_photo_poses(out / f"{name}.json", PhotoPoses(camera_entry(result, facts.factor), entries))


def objects_of(
    slice_: schema.ObjectsSlice,
    channels: dict,
    inputs: Inputs,
    params: Params,
    factor: int = 1,
    earlier: PhotoPoses | None = None,
) -> list[ObjectToPlace]:
    """Every object of the photo, which was averaged down by `factor`; poses that dataset.yaml or its source of cameras gives go
    before those found earlier, these before keypoints."""
    objects = []
    for number, obj in enumerate(slice_.objects, start=1):
        mesh, materials = slice_.meshes[obj.mesh], inputs.facts["dataset.materials"]
        file = inputs.file(mesh.file)
        pose = pose_of(obj, slice_.external)
        before = earlier.objects.get(obj.name) if earlier and pose is None else None
        scale = before.scale if before else AS_IT_IS
        caster = Caster(scaled(_mesh(file, mesh, obj, materials, params), scale))
        silhouette = silhouette_of_object(channels, number, caster.mesh.labels, obj.mask is not None)
        found = earlier_pose(before) if before else None
        objects.append(ObjectToPlace(obj.name, caster, silhouette, pose, keypoints_of(obj, factor), found, scale))
    return objects


def _mesh(file: Path, mesh: schema.MeshEntry, obj: schema.ObjectEntry, materials: list[str], params: Params) -> Mesh:
    return read_mesh(file, materials, mesh.made_of, obj.materials, params.crease_deg, params.limits)


def check_given_poses(slice_: schema.ObjectsSlice, objects: list[ObjectToPlace], photo: str) -> None:
    """Raise InputError where a pose of dataset.yaml, or of its source of cameras, puts its object behind the camera."""
    for each, said in zip(objects, slice_.objects, strict=True):
        if each.pose is not None:
            check_before_camera(
                each.caster.mesh, each.pose, photo, each.name, "dataset" if said.pose else slice_.external.source
            )


def pose_of(obj: schema.ObjectEntry, external: schema.ExternalCamera | None) -> Pose | None:
    """The pose that dataset.yaml gives, or else its source of cameras."""
    pose = obj.pose or (external.poses.get(obj.name) if external else None)
    return Pose(np.array(pose.rotation), np.array(pose.translation)) if pose else None


def keypoints_of(obj: schema.ObjectEntry, factor: int) -> Keypoints | None:
    """In pixels of the photo averaged down by `factor`."""
    if not obj.keypoints:
        return None
    return Keypoints(np.array([k.pixel for k in obj.keypoints]) / factor, np.array([k.point for k in obj.keypoints]))


def camera_of(slice_: schema.ObjectsSlice, facts: PhotoFacts, photo: str) -> tuple[Camera, KnownFocal]:
    """The photo's camera, its focal length to be found later, and what is known of that length.

    What dataset.yaml gives goes before what its source of cameras gives, and that before EXIF and the middle of the photo.
    Both say so in pixels of the photo's file, of which `masks` made a box one pixel.
    """
    factor, (width, height) = facts.factor, facts.original_size
    focal, source, centre = facts.focal_px, facts.focal_source, (width / 2, height / 2)
    if slice_.external is not None and (source != "dataset" or slice_.camera.principal_point is None):
        external_focal, centre = focal_and_centre(slice_.external, width, height, photo)
        if source != "dataset":
            focal, source = external_focal / factor, slice_.external.source
    across, down = slice_.camera.principal_point or centre
    return Camera(facts.width, facts.height, 1.0, (across / factor, down / factor)), KnownFocal(focal, source)


def camera_entry(result: Placed, factor: int) -> CameraEntry:
    """Pixels are those of the stage's maps, `factor` of the photo's each."""
    camera = result.camera
    centre = float(camera.centre[0]), float(camera.centre[1])
    return CameraEntry(float(camera.focal), centre, result.focal_source, result.log_focal_sigma, factor)


def entry(obj: ObjectToPlace, k: int, result: Placed, maps: Maps, params: Params, source: str | None) -> ObjectEntry:
    """What poses.json says of one object; `doubts` is empty for a pose to be believed, one found that is not is left out.

    source: where the pose is from, if it was not searched.
    """
    seen = np.where(maps.object == k + 1, maps.label, 0)
    iou, agreement = silhouette_iou(obj.silhouette, seen), label_agreement(obj.silhouette, seen)
    found, pose, trust = result.found[k], result.poses[k], trust_in(obj, result, k)
    reasons = doubts(iou, agreement, trust, found, params)
    return ObjectEntry(
        **entry_of(pose),
        scale=obj.scale,
        silhouette_iou=iou,
        label_agreement=agreement,
        source=source
        if found is None
        else "refined"
        if found.earlier
        else "keypoints"
        if found.by_keypoints
        else "found",
        score=found.score if found else None,
        runner_up=runner_up_entry(found, obj.caster),
        **msgspec.structs.asdict(trust),
        doubts=reasons,
        left_out=bool(reasons) and found is not None and not params.keep_doubtful,
    )


def runner_up_entry(found: Found | None, caster: Caster) -> RunnerUp | None:
    """The second-best pose as it stands in poses.json; None where no other was found."""
    if found is None or found.runner_up is None:
        return None
    other = found.runner_up
    return RunnerUp(
        **entry_of(other.state.pose(caster)), score=other.score, normal_difference_deg=other.normal_difference_deg
    )


def complain(photo: str, name: str, entry: ObjectEntry, strict: bool) -> None:
    """Warn of a pose's doubts; `strict`: raise InputError for the first instead."""
    cure = CURE_OF_EXTERNAL if entry.source in schema.SOURCES else CURE
    for reason in entry.doubts:
        if strict:
            raise InputError(reason, file="dataset.yaml", key=f"{photo}.{name}", cure=cure)
        log.warning("%s: %s: %s; %s", photo, name, reason, cure)
    if entry.left_out:
        log.warning('%s: %s is left out of the solve; SET="align.keep_doubtful=true" lets it in as it is', photo, name)


def write_maps(path: Path, maps: Maps, certainty: np.ndarray) -> None:
    """Write the maps of a photo as EXR; the channels are listed in docs/formats.md.

    certainty: [h, w], how much a pixel's normal is to be believed, 0 to 1
    """
    channels = {f"normal.{a}": maps.normal[..., k] for k, a in enumerate("xyz")}
    channels |= {f"view.{a}": maps.view[..., k] for k, a in enumerate("xyz")}
    channels |= {
        "depth": maps.depth,
        "label": maps.label,
        "object": maps.object,
        "confidence": certainty,
        "back": maps.back,
    }
    write_exr(path, channels)
