"""A mesh that is like the object but for its proportions: factors of its three axes, fitted once per mesh over all photos.

Only where that pays on photos that had no say: see `factorlib.align.proportions`.  Writes meshes.json (factors, evidence) and
poses.json (poses in the fitted mesh's frame, with its `scale`), which SET="align.poses=build/<dataset>/fit_mesh" uses.
"""

import logging
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np

from factorlib.align.proportions import Sighting, Standards, Verdict, proportions
from factorlib.align.refine import FocalPrior
from factorlib.align.search import prior_before
from factorlib.align.silhouette import silhouette_iou, silhouette_of_object
from factorlib.align.state import State, state_of
from factorlib.align.target import target_of
from factorlib.dataset.schema import ObjectsSlice
from factorlib.geometry.raster import Caster, rasterise
from factorlib.images.exr import read_exr
from factorlib.jsonfile import write_json
from factorlib.meshes.limits import NO_LIMITS
from factorlib.meshes.mesh import scaled
from factorlib.meshes.read import read_mesh
from factorlib.results.photos import read_photo_facts
from factorlib.results.poses import FILE, SEARCHED, PhotoPoses, entry_of, read_poses, write_poses
from factorlib.stage import Inputs, Progress

log = logging.getLogger("factorlib.align")
MARGIN = 0.15  # of the mask's extent, seen around it


class Params(Standards, frozen=True, forbid_unknown_fields=True):
    """When factors of a mesh's axes are used, and what they are fitted to."""

    resolution: Annotated[int, msgspec.Meta(ge=50, le=2000)] = 200
    """Pixels of a mask's longer side, to which it is scaled."""
    least_iou: Annotated[float, msgspec.Meta(ge=0, le=1)] = 0.6
    """Least overlap of mesh and mask at a pose that factors are fitted from."""


class Found(msgspec.Struct, frozen=True):
    """A sighting and where it stands: photo, object, and the silhouette that its overlap is measured by."""

    photo: str
    object: str
    sighting: Sighting
    silhouette: object


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Fit the proportions of every mesh, and write meshes.json and poses.json."""
    poses, slices = read_poses(inputs["align"] / FILE), inputs.facts["dataset.objects"]
    found: dict[str, list[Found]] = {}
    for photo in sorted(poses):
        for mesh, one in sightings_of(
            photo, msgspec.convert(slices[photo], ObjectsSlice), poses[photo], inputs, params
        ):
            found.setdefault(mesh, []).append(one)
    report = {}
    for done, (mesh, sightings) in enumerate(sorted(found.items())):
        progress(done, len(found), mesh)
        verdict = proportions([one.sighting for one in sightings], params)
        report[mesh] = fitted(verdict, sightings)
        if verdict.used:
            log.warning(
                "mesh '%s' fits better with its axes times %s",
                mesh,
                ", ".join(f"{f:.3f}" for f in verdict.fitted.factors),
            )
            for one, state in zip(sightings, verdict.fitted.states, strict=True):
                poses[one.photo] = placed(poses[one.photo], one, state, verdict.fitted.factors)
    write_json(out / "meshes.json", report)
    write_poses(out / FILE, poses)


def sightings_of(
    photo: str, slice_: ObjectsSlice, entry: PhotoPoses, inputs: Inputs, params: Params
) -> Iterator[tuple[str, Found]]:
    """(mesh, sighting) of every object whose pose was found, with its mask and the mesh as its file has it."""
    channels, facts = read_exr(inputs["masks"] / f"{photo}.exr"), read_photo_facts(inputs["masks"] / f"{photo}.json")
    height, width = channels["label"].shape
    camera = entry.camera.camera(width, height)
    prior = prior_before(camera.focal, entry.camera.focal_source, facts.focal_px, width, height)
    alone = prior if len(slice_.objects) == 1 else FocalPrior(camera.focal, 0.0)
    for number, obj in enumerate(slice_.objects, start=1):
        found, mesh = entry.objects[obj.name], slice_.meshes[obj.mesh]
        if found.source not in SEARCHED or (found.silhouette_iou or 0.0) < params.least_iou:
            continue
        read = read_mesh(
            inputs.file(mesh.file), inputs.facts["dataset.materials"], mesh.made_of, obj.materials, limits=NO_LIMITS
        )
        silhouette = silhouette_of_object(channels, number, read.labels, obj.mask is not None)
        state = state_of(found.pose, camera, scaled(read, found.scale))
        target = target_of(silhouette, read.labels, params.resolution, MARGIN)
        yield obj.mesh, Found(photo, obj.name, Sighting(read, target, camera, alone, state), silhouette)


def fitted(verdict: Verdict, sightings: list[Found]) -> dict:
    """Of meshes.json."""
    return {
        "factors": verdict.fitted.factors.tolist(),
        "used": verdict.used,
        "reason": verdict.reason,
        "held_out_unexplained": {"as_it_is": verdict.held_out_before, "fitted": verdict.held_out_after},
        "sightings": [f"{one.photo}.{one.object}" for one in sightings],
    }


def placed(entry: PhotoPoses, one: Found, state: State, factors: np.ndarray) -> PhotoPoses:
    """The photo's entry of poses.json with an object's pose of the fitted mesh; its runner-up was of another mesh."""
    caster = Caster(scaled(one.sighting.mesh, factors))
    pose, seen = state.pose(caster), state.camera(one.sighting.camera)
    camera = (
        msgspec.structs.replace(entry.camera, focal_px=float(seen.focal))
        if one.sighting.prior.sigma > 0
        else entry.camera
    )
    iou = silhouette_iou(one.silhouette, rasterise(caster, seen, pose).label)
    changed = {**entry_of(pose), "scale": tuple(factors.tolist()), "silhouette_iou": iou, "runner_up": None}
    return PhotoPoses(
        camera, entry.objects | {one.object: msgspec.structs.replace(entry.objects[one.object], **changed)}
    )
