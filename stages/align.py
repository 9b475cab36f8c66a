"""Pose estimation: poses of the meshes in one photo, with maps of normals, view directions, depth and labels.

Writes <photo>.json (camera and poses), <photo>.exr (maps in the camera frame) and <photo>_overlay.png.
"""

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np

from factorlib.align.input_checks import camera_of_photo, check_before_camera, warn_of_camera, warn_of_materials
from factorlib.align.photo_alignment import Keypoints, ObjectToAlign, PhotoAlignment, align_photo
from factorlib.align.reliability import Thresholds, confidence, find_doubts, measure_reliability, overlay
from factorlib.align.search import SearchOptions
from factorlib.align.silhouette import label_agreement, silhouette_iou, silhouette_of_object, silhouette_of_photo
from factorlib.dataset.schema import SOURCES, ObjectsSlice
from factorlib.geometry.camera import Pose
from factorlib.geometry.raster import Caster, Maps, rasterise
from factorlib.images.exr import read_exr, write_exr
from factorlib.images.lens import radial_lens
from factorlib.images.picture import write_png
from factorlib.jsonfile import write_json
from factorlib.meshes.read_mesh import CREASE_DEG, read_mesh
from factorlib.meshes.triangle_soup import Limits
from factorlib.results.photos import read_photo_facts
from factorlib.results.poses import CameraEntry, ObjectPose, PhotoPoses, pose_fields
from factorlib.results.shape_table import read_shapes
from factorlib.stage import Inputs, Progress

log = logging.getLogger("factorlib.align")
CURE = (
    "look at its overlay: is the mask whole there? Where it is, give the object's keypoints or pose, or the photo's "
    "camera.focal_px, in dataset.yaml"
)
EXTERNAL_CURE = (
    "look at its overlay; does the source show this photo, and is the mesh where world_from_object or obj_ids say?"
)


class Params(Thresholds, frozen=True, forbid_unknown_fields=True):
    """Parameters of mesh reading and pose search, and the handling of doubtful poses."""

    crease_deg: Annotated[float, msgspec.Meta(gt=0, le=180)] = CREASE_DEG
    """Crease angle, in degrees: an edge whose two triangles differ by more in their normals stays sharp."""
    keep_doubtful: bool = False
    """Use objects with a doubtful estimated pose in the solve; otherwise they are left out."""
    limits: Limits = Limits()
    search: SearchOptions = SearchOptions()


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Align the meshes of one photo and write its maps, its poses and the overlay."""
    name = inputs.photo
    assert name is not None  # a stage over one photo
    slice_ = msgspec.convert(inputs.facts["dataset.objects"], ObjectsSlice)
    if by_motion := read_shapes(inputs.folders.get("shapes")).cameras.get(name):
        slice_ = msgspec.structs.replace(slice_, external=by_motion)
    channels = read_exr(inputs["masks"] / f"{name}.exr")
    facts = read_photo_facts(inputs["masks"] / f"{name}.json")
    objects = read_objects(slice_, channels, inputs, params, facts.factor)
    camera, known = camera_of_photo(slice_, facts, name)
    external = slice_.external.source if slice_.external else None
    sources = ["given" if entry.pose else external for entry in slice_.objects]
    # given data: refuse objects behind the camera, warn of materials that do not match and of an unlikely camera
    for obj, source in zip(objects, sources, strict=True):
        if obj.pose is not None:
            pose_source = "dataset" if source is None or source == "given" else source
            check_before_camera(obj.caster.mesh, obj.pose, name, obj.name, pose_source)
    object_labels = [obj.caster.mesh.labels for obj in objects]
    warn_of_materials(channels["label"], object_labels, inputs.facts["dataset.materials"], name)
    warn_of_camera(known.focal, camera.centre, (camera.width, camera.height), name)
    pieces = 2 * len(objects)  # a pose and a check of it for each object
    result = align_photo(objects, camera, known, name, params.search, lambda done: progress(done, pieces, name))
    maps = rasterise([obj.caster for obj in objects], result.camera, result.poses)
    entries = {}
    for k, obj in enumerate(objects):
        progress(len(objects) + k, pieces, f"{name}: how sure {obj.name} is")
        entries[obj.name] = object_entry(obj, k, result, maps, params, sources[k])
    for obj_name, entry in entries.items():
        report_doubts(name, obj_name, entry)
    write_maps(out, name, channels, maps, [entry.left_out for entry in entries.values()])
    x, y = result.camera.centre
    focal = float(result.camera.focal)
    camera_entry = CameraEntry(focal, (float(x), float(y)), result.focal_source, result.log_focal_sigma, facts.factor)
    write_json(out / f"{name}.json", PhotoPoses(camera_entry, entries))


def write_maps(out: Path, name: str, channels: Mapping[str, np.ndarray], maps: Maps, left_out: Sequence[bool]) -> None:
    """Write the maps of a photo and the overlay; pixels of objects that are left out have confidence 0.

    Args:
        out: Folder of the results.
        name: Name of the photo.
        channels: Channels of the EXR that `masks` writes.
        maps: Maps of the rasterised objects.
        left_out: True for each object that is left out.
    """
    mask = silhouette_of_photo(channels)
    write_png(out / f"{name}_overlay.png", overlay(np.stack([channels[c] for c in "RGB"], axis=-1), maps, mask))
    layers = {f"{kind}.{a}": getattr(maps, kind)[..., k] for kind in ("normal", "view") for k, a in enumerate("xyz")}
    layers |= {kind: getattr(maps, kind) for kind in ("depth", "label", "object")}
    excluded = np.isin(maps.object, np.flatnonzero(left_out) + 1)
    sure = np.where(excluded, 0.0, confidence(maps, mask))
    write_exr(out / f"{name}.exr", {**layers, "confidence": sure, "back": maps.back})


def read_objects(
    slice_: ObjectsSlice, channels: dict, inputs: Inputs, params: Params, factor: int
) -> list[ObjectToAlign]:
    """Read every object of the photo, with its mesh, its silhouette and its pose or keypoints, if they are known.

    A pose in dataset.yaml or in its camera source takes precedence over keypoints.

    Args:
        slice_: Objects, meshes and camera of the photo.
        channels: Channels of the EXR that `masks` writes.
        inputs: Inputs of the stage.
        params: Parameters of the stage.
        factor: Factor by which `masks` reduced the photo.
    """
    objects = []
    materials = inputs.facts["dataset.materials"]
    for number, entry in enumerate(slice_.objects, start=1):
        mesh_entry = slice_.meshes[entry.mesh]
        fixed_pose = entry.pose
        keypoints = None
        if fixed_pose is None and slice_.external:
            fixed_pose = slice_.external.poses.get(entry.name)
        file = inputs.mesh(entry.mesh, mesh_entry.file)
        mesh = read_mesh(file, materials, mesh_entry.part_materials, entry.materials, params.crease_deg, params.limits)
        silhouette = silhouette_of_object(channels, number, mesh.labels, entry.mask is not None)
        pose = Pose(np.array(fixed_pose.rotation), np.array(fixed_pose.translation)) if fixed_pose is not None else None
        if entry.keypoints:  # pixels of the file, to undistorted pixels of the reduced photo
            pixels = np.array([keypoint.pixel for keypoint in entry.keypoints]) / factor
            points = np.array([keypoint.point for keypoint in entry.keypoints])
            lens = radial_lens(slice_.camera, factor, *channels["label"].shape[::-1])
            keypoints = Keypoints(lens.undistort(pixels) if lens else pixels, points)
        objects.append(ObjectToAlign(entry.name, Caster(mesh), silhouette, pose, keypoints))
    return objects


def object_entry(
    obj: ObjectToAlign, k: int, result: PhotoAlignment, maps: Maps, params: Params, source: str | None
) -> ObjectPose:
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
    estimate = result.estimates[k]
    measures = measure_reliability(obj, result, k)
    reasons = find_doubts(iou, agreement, measures, estimate, params)
    return ObjectPose(
        **pose_fields(result.poses[k]),
        silhouette_iou=iou,
        label_agreement=agreement,
        source=estimate.source if estimate else source,
        score=estimate.score if estimate else None,
        runner_up=estimate.runner_up if estimate else None,
        contour_error=measures.contour_error,
        normal_stderr_deg=measures.normal_stderr_deg,
        doubts=reasons,
        left_out=bool(reasons) and estimate is not None and not params.keep_doubtful,
    )


def report_doubts(photo: str, name: str, entry: ObjectPose) -> None:
    """Warn of each doubt about a pose."""
    cure = EXTERNAL_CURE if entry.source in (*SOURCES, "sfm") else CURE
    for reason in entry.doubts:
        log.warning("%s: %s: %s; %s", photo, name, reason, cure)
    if entry.left_out:
        log.warning('%s: %s is left out of the solve; SET="align.keep_doubtful=true" lets it in as it is', photo, name)
