"""Pose estimation: poses of the meshes in one photo, with maps of normals, view directions, depth and labels.

Writes <photo>.json (camera and poses), <photo>.exr (maps in the camera frame) and <photo>_overlay.png.
"""

import logging
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np

from factorlib.align.confidence import confidence, overlay
from factorlib.align.given import camera_of, check_before_camera, warn_of_camera, warn_of_materials
from factorlib.align.place import Keypoints, ObjectToPlace, Placed, placed
from factorlib.align.search import Search
from factorlib.align.silhouette import label_agreement, silhouette_iou, silhouette_of_object, silhouette_of_photo
from factorlib.align.trust import Standards, doubts, trust_in
from factorlib.dataset.schema import SOURCES, ObjectsSlice
from factorlib.errors import InputError
from factorlib.geometry.camera import Pose
from factorlib.geometry.raster import Caster, Maps, rasterise
from factorlib.images.exr import read_exr, write_exr
from factorlib.images.lens import lens_of
from factorlib.images.picture import write_png
from factorlib.jsonfile import write_json
from factorlib.meshes.limits import Limits
from factorlib.meshes.mesh import scaled
from factorlib.meshes.read import CREASE_DEG, read_mesh
from factorlib.results.photos import read_photo_facts
from factorlib.results.poses import (
    AS_IT_IS,
    FILE,
    CameraEntry,
    ObjectPose,
    PhotoPoses,
    RunnerUpPose,
    entry_of,
    read_poses,
)
from factorlib.results.shape_table import read_shapes
from factorlib.stage import Inputs, Progress

log = logging.getLogger("factorlib.align")
CURE = (
    "look at its overlay: is the mask whole there? Where it is, give the object's keypoints or pose, or the photo's "
    "camera.focal_px, in dataset.yaml"
)
EXTERNAL = (
    "look at its overlay; does the source show this photo, and is the mesh where world_from_object or obj_ids say?"
)


class Params(Standards, frozen=True, forbid_unknown_fields=True):
    """Parameters of mesh reading and pose search, and the handling of doubtful poses."""

    crease_deg: Annotated[float, msgspec.Meta(gt=0, le=180)] = CREASE_DEG
    """Crease angle, in degrees: an edge whose two triangles differ by more in their normals stays sharp."""
    strict: bool = False
    """Stop the run at a doubtful pose."""
    keep_doubtful: bool = False
    """Use objects with a doubtful estimated pose in the solve; otherwise they are left out."""
    limits: Limits = Limits()
    search: Search = Search()


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Align the meshes of one photo and write its maps, its poses and the overlay."""
    name = inputs.photo
    assert name is not None  # a stage over one photo
    materials = inputs.facts["dataset.materials"]
    slice_ = msgspec.convert(inputs.facts["dataset.objects"], ObjectsSlice)
    if by_motion := read_shapes(inputs.folders.get("shapes")).cameras.get(name):
        slice_ = msgspec.structs.replace(slice_, external=by_motion)
    channels = read_exr(inputs["masks"] / f"{name}.exr")
    facts = read_photo_facts(inputs["masks"] / f"{name}.json")
    earlier = read_poses(inputs["poses"] / FILE).get(name) if "poses" in inputs.folders else None
    objects = objects_of(slice_, channels, inputs, params, facts.factor, earlier)
    camera, known = camera_of(slice_, facts, name)
    external = slice_.external.source if slice_.external else None
    sources = ["given" if own.pose else external for own in slice_.objects]
    # given data: refuse objects behind the camera, warn of materials that do not match and of an unlikely camera
    for each, source in zip(objects, sources, strict=True):
        if each.pose is not None:
            given_by = "dataset" if source is None or source == "given" else source
            check_before_camera(each.caster.mesh, each.pose, name, each.name, given_by)
    warn_of_materials(channels["label"], [each.caster.mesh.labels for each in objects], materials, name)
    warn_of_camera(known.focal, camera.centre, (camera.width, camera.height), name)
    # focal length of an earlier run, in pixels of this one: the two may have reduced the photo by different factors
    before = None
    if earlier:
        focal = earlier.camera.focal_px * (earlier.camera.factor / facts.factor)
        before = msgspec.structs.replace(earlier.camera, focal_px=focal, factor=facts.factor)
    pieces = 2 * len(objects)  # a pose and a check of it for each object
    result = placed(objects, camera, known, name, params.search, before, lambda done: progress(done, pieces, name))
    camera = result.camera
    maps = rasterise([each.caster for each in objects], result.camera, result.poses)
    whole = silhouette_of_photo(channels)
    write_png(out / f"{name}_overlay.png", overlay(np.stack([channels[c] for c in "RGB"], axis=-1), maps, whole))
    entries = []
    for k, each in enumerate(objects):
        progress(len(objects) + k, pieces, f"{name}: how sure {each.name} is")
        entries.append(entry(each, k, result, maps, params, sources[k]))
    for each, of_each in zip(objects, entries, strict=True):
        complain(name, each.name, of_each, params.strict)
    # maps of the photo; pixels of objects that are left out have confidence 0
    left_out = np.isin(maps.object, [k for k, of_each in enumerate(entries, start=1) if of_each.left_out])
    channels = {f"{kind}.{a}": getattr(maps, kind)[..., k] for kind in ("normal", "view") for k, a in enumerate("xyz")}
    channels |= {kind: getattr(maps, kind) for kind in ("depth", "label", "object")}
    certainty = np.where(left_out, 0.0, confidence(maps, whole))
    write_exr(out / f"{name}.exr", {**channels, "confidence": certainty, "back": maps.back})
    centre = float(camera.centre[0]), float(camera.centre[1])
    of_camera = CameraEntry(float(camera.focal), centre, result.focal_source, result.log_focal_sigma, facts.factor)
    poses = {each.name: of_each for each, of_each in zip(objects, entries, strict=True)}
    write_json(out / f"{name}.json", PhotoPoses(of_camera, poses))


def objects_of(
    slice_: ObjectsSlice, channels: dict, inputs: Inputs, params: Params, factor: int, earlier: PhotoPoses | None
) -> list[ObjectToPlace]:
    """Return every object of the photo, with its mesh, its silhouette and what is known of its pose.

    A pose in dataset.yaml or in its camera source takes precedence over one of an earlier run, and that over keypoints.

    Args:
        slice_: Objects, meshes and camera of the photo.
        channels: Channels of the EXR that `masks` writes.
        inputs: Inputs of the stage.
        params: Parameters of the stage.
        factor: Factor by which `masks` reduced the photo.
        earlier: Poses of an earlier run, or None.
    """
    objects = []
    materials = inputs.facts["dataset.materials"]
    for number, own in enumerate(slice_.objects, start=1):
        mesh = slice_.meshes[own.mesh]
        given = own.pose
        keypoints = None
        if given is None and slice_.external:
            given = slice_.external.poses.get(own.name)
        before = earlier.objects.get(own.name) if earlier and given is None else None
        file = inputs.mesh(own.mesh, mesh.file)
        scale = before.scale if before else AS_IT_IS
        read = read_mesh(file, materials, mesh.made_of, own.materials, params.crease_deg, params.limits)
        silhouette = silhouette_of_object(channels, number, read.labels, own.mask is not None)
        pose = Pose(np.array(given.rotation), np.array(given.translation)) if given is not None else None
        if own.keypoints:  # pixels of the file, to undistorted pixels of the reduced photo
            pixels, points = (np.array([getattr(k, of) for k in own.keypoints]) for of in ("pixel", "point"))
            pixels = pixels / factor
            lens = lens_of(slice_.camera, factor, *channels["label"].shape[::-1])
            keypoints = Keypoints(lens.undistorted(pixels) if lens else pixels, points)
        caster = Caster(scaled(read, scale))
        objects.append(ObjectToPlace(own.name, caster, silhouette, pose, keypoints, before, scale))
    return objects


def entry(obj: ObjectToPlace, k: int, result: Placed, maps: Maps, params: Params, source: str | None) -> ObjectPose:
    """Return the entry of one object in poses.json.

    A pose without `doubts` is reliable.  An object with a doubtful estimated pose is left out of the solve.

    Args:
        obj: Object, with its silhouette.
        k: Index of the object in the photo, from 0.
        result: Poses and camera.
        maps: Maps of the rasterised objects.
        params: Parameters of the stage.
        source: Source of the pose, if it was not searched.
    """
    label = np.where(maps.object == k + 1, maps.label, 0)
    iou = silhouette_iou(obj.silhouette, label)
    agreement = label_agreement(obj.silhouette, label)
    found = result.found[k]
    trust = trust_in(obj, result, k)
    runner_up = None
    reasons = doubts(iou, agreement, trust, found, params)
    if found is not None:
        source = "refined" if found.earlier else "keypoints" if found.by_keypoints else "found"
        if other := found.runner_up:
            pose = entry_of(other.state.pose(obj.caster))
            runner_up = RunnerUpPose(**pose, score=other.score, normal_difference_deg=other.normal_difference_deg)
    return ObjectPose(
        **entry_of(result.poses[k]),
        scale=obj.scale,
        silhouette_iou=iou,
        label_agreement=agreement,
        source=source,
        score=found.score if found else None,
        runner_up=runner_up,
        contour_error=trust.contour_error,
        normal_stderr_deg=trust.normal_stderr_deg,
        mirrored_score=trust.mirrored_score,
        doubts=reasons,
        left_out=bool(reasons) and found is not None and not params.keep_doubtful,
    )


def complain(photo: str, name: str, entry: ObjectPose, strict: bool) -> None:
    """Warn of each doubt about a pose.

    Raises:
        InputError: With `strict`, for the first doubt.
    """
    cure = EXTERNAL if entry.source in (*SOURCES, "sfm") else CURE
    for reason in entry.doubts:
        if strict:
            raise InputError(reason, file="dataset.yaml", key=f"{photo}.{name}", cure=cure)
        log.warning("%s: %s: %s; %s", photo, name, reason, cure)
    if entry.left_out:
        log.warning('%s: %s is left out of the solve; SET="align.keep_doubtful=true" lets it in as it is', photo, name)
