"""Proportions of meshes: scale factors of each mesh's three axes, fitted to all photos together.

Factors are used only if they improve held-out photos (`factorlib.align.proportions`).  Writes meshes.json (factors and
evidence) and poses.json (poses in the fitted mesh's frame, with its `scale`).
SET="align.poses=build/<dataset>/fit_mesh" uses the latter.
"""

import logging
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np

from factorlib.align.photo import AlignedObject, aligned_photo
from factorlib.align.proportions import Sighting, Standards, proportions
from factorlib.align.refine import FocalPrior
from factorlib.align.silhouette import silhouette_iou
from factorlib.align.state import State, state_of
from factorlib.align.target import target_of
from factorlib.dataset.schema import ObjectsSlice
from factorlib.geometry.raster import Caster, rasterise
from factorlib.jsonfile import write_json
from factorlib.meshes.mesh import scaled
from factorlib.meshes.read import CREASE_DEG, MeshesOnce
from factorlib.results.poses import FILE, PhotoPoses, entry_of, read_poses
from factorlib.stage import Inputs, Progress

log = logging.getLogger("factorlib.align")
MARGIN = 0.15  # margin around the mask, as a share of its extent


class Params(Standards, frozen=True, forbid_unknown_fields=True):
    """Parameters of the fit of axis factors, and criteria for their use."""

    resolution: Annotated[int, msgspec.Meta(ge=50, le=2000)] = 200
    """Length, in pixels, to which the longer side of a mask is scaled."""
    least_iou: Annotated[float, msgspec.Meta(ge=0, le=1)] = 0.6
    """Smallest overlap (IoU) of mesh and mask at a pose that factors are fitted from."""


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Fit the proportions of every mesh, and write meshes.json and poses.json."""
    poses = read_poses(inputs["align"] / FILE)
    sightings = {}  # by mesh, then by photo and object: the object and its sighting
    meshes = MeshesOnce(inputs.mesh, inputs.facts["dataset.materials"], CREASE_DEG)
    # sightings: objects with an estimated pose that overlaps its mask well enough
    for photo in sorted(poses):
        slice_ = msgspec.convert(inputs.facts["dataset.objects"][photo], ObjectsSlice)
        aligned = aligned_photo(inputs["masks"], photo, slice_, poses[photo], meshes)
        prior = aligned.prior if len(aligned.objects) == 1 else FocalPrior(aligned.camera.focal, 0.0)
        for name, own in aligned.objects.items():
            if own.moves and (own.entry.silhouette_iou or 0.0) >= params.least_iou:
                state = state_of(own.entry.pose, aligned.camera, scaled(own.mesh, own.entry.scale))
                target = target_of(own.silhouette, own.mesh.labels, params.resolution, MARGIN)
                sighting = Sighting(own.mesh, target, aligned.camera, prior, state)
                sightings.setdefault(own.mesh_name, {})[photo, name] = own, sighting
    report = {}
    for done, (mesh, each) in enumerate(sorted(sightings.items())):
        progress(done, len(sightings), mesh)
        verdict = proportions([sighting for _, sighting in each.values()], params)
        report[mesh] = {
            "factors": verdict.factors.tolist(),
            "used": verdict.used,
            "reason": verdict.reason,
            "held_out_unexplained": {"as_it_is": verdict.held_out_before, "fitted": verdict.held_out_after},
            "sightings": [f"{photo}.{name}" for photo, name in each],
        }
        if verdict.used:
            factors = verdict.factors
            log.warning("mesh '%s' fits better with its axes times %s", mesh, ", ".join(f"{f:.3f}" for f in factors))
            for (photo, name), state in zip(each, verdict.states, strict=True):
                poses[photo] = placed(poses[photo], name, *each[photo, name], state, factors)
    write_json(out / "meshes.json", report)
    write_json(out / FILE, poses)


def placed(
    entry: PhotoPoses, name: str, own: AlignedObject, sighting: Sighting, state: State, factors: np.ndarray
) -> PhotoPoses:
    """Return the photo's entry of poses.json with an object's pose for the fitted mesh.

    The runner-up is dropped, because it was a pose of the mesh as given.

    Args:
        entry: The photo's entry as `align` wrote it.
        name: Name of the object.
        own: Object, with its mesh as given and its silhouette.
        sighting: Observation that the factors were fitted to.
        state: Fitted pose and focal length.
        factors: Scale factors of the mesh's axes, [3].
    """
    caster = Caster(scaled(own.mesh, factors))
    pose = state.pose(caster)
    camera = state.camera(sighting.camera)
    camera_entry = entry.camera
    if sighting.prior.sigma > 0:
        camera_entry = msgspec.structs.replace(camera_entry, focal_px=float(camera.focal))
    iou = silhouette_iou(own.silhouette, rasterise(caster, camera, pose).label)
    changed = {**entry_of(pose), "scale": tuple(factors.tolist()), "silhouette_iou": iou, "runner_up": None}
    return PhotoPoses(camera_entry, entry.objects | {name: msgspec.structs.replace(entry.objects[name], **changed)})
