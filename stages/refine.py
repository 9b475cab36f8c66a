"""Poses by shading: what silhouettes leave open, the solved materials decide.

Each pose that was found is moved by contours and shading together, and so is its runner-up.  What explains held-out pixels better
than the pose found, by a stated gain, takes its place; else the pose stays.  SET="align.poses=build/<dataset>/refine" uses it.
"""

import logging
from pathlib import Path
from typing import Annotated

import msgspec

from factorlib.align.photo import aligned_photo
from factorlib.align.search import normal_difference, seen_in
from factorlib.align.silhouette import silhouette_iou
from factorlib.align.target import target_of
from factorlib.dataset.schema import ObjectsSlice
from factorlib.geometry.camera import Camera, angle_between
from factorlib.geometry.raster import rasterise
from factorlib.images.tone import straightened
from factorlib.jsonfile import write_json
from factorlib.meshes.read import CREASE_DEG, MeshesOnce
from factorlib.refine.choice import Standards
from factorlib.refine.light import Surfaces, known_materials
from factorlib.refine.photo import PosedObject, Refined, Scene, refined_photo
from factorlib.refine.pixels import pixels_of
from factorlib.reflection import reflection_operator
from factorlib.results.materials import in_order, read_materials
from factorlib.results.poses import (
    CandidateEntry,
    Moved,
    ObjectEntry,
    PhotoPoses,
    Refinement,
    entry_of,
    read_photo_poses,
)
from factorlib.stage import Inputs, Progress

log = logging.getLogger("factorlib.refine")


class Params(Standards, frozen=True, forbid_unknown_fields=True):
    """When a pose is replaced, and what is compared."""

    pixels: Annotated[int, msgspec.Meta(ge=500)] = 2400
    """Pixels of a photo that are compared."""
    directions: Annotated[int, msgspec.Meta(ge=32, le=4096)] = 256
    """Directions of the sphere in which objects cast shadows on each other, where the solve had shadows."""
    seed: Annotated[int, msgspec.Meta(ge=0)] = 0
    """Seed of the choice of pixels."""


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Refine the poses of one photo's objects, and write its entry of poses.json with what decided."""
    name, names, file = inputs.photo, inputs.facts["dataset.materials"], inputs["solve"] / "materials.json"
    entry, table = read_photo_poses(inputs["align"] / f"{name}.json"), read_materials(file)
    slice_ = msgspec.convert(inputs.facts["dataset.objects"], ObjectsSlice)
    aligned = aligned_photo(inputs["masks"], name, slice_, entry, MeshesOnce(inputs.mesh, names, CREASE_DEG))
    materials, known = known_materials(in_order(table, names, file))
    channels = aligned.channels
    if tone := table.model.tone.get(name):
        channels = channels | {c: straightened(channels[c], tone.exponent, tone.pivot) for c in "RGB"}
    posed = []
    for own in aligned.objects.values():
        rival = own.entry.runner_up.pose if own.entry.runner_up else None
        seen = own.caster(), own.silhouette, own.entry.pose, rival
        posed.append(PosedObject(*seen, own.moves, not own.entry.left_out))
    scene = Scene(aligned.camera, posed, aligned.prior, params.directions if table.model.self_shadowing else 0)
    pixels = pixels_of(channels, known, params.pixels, params.seed)
    if pixels is None:
        log.warning("%s: too few pixels of known materials to tell poses by: they stay as they were found", name)
    surfaces = Surfaces(materials, reflection_operator("network", weights=inputs["train"]))
    results = refined_photo(scene, pixels, surfaces, params, lambda done, total: progress(done, total, name))
    camera, objects = entry.camera, {}
    for (own, found), result, posed in zip(entry.objects.items(), results, scene.objects, strict=True):
        objects[own] = decided(found, posed, result, scene.camera)
        if result.moved:
            log.warning("%s: shading moves %s by %.1f°", name, own, objects[own].refined.moved.rotation_deg)
            camera = msgspec.structs.replace(camera, focal_px=float(result.after.camera(scene.camera).focal))
    write_json(out / f"{name}.json", PhotoPoses(camera, objects))


def decided(entry: ObjectEntry, own: PosedObject, result: Refined, camera: Camera) -> ObjectEntry:
    """The object's entry of poses.json with what shading decided."""
    verdict, changed = result.settled, {}
    if verdict is None:
        return msgspec.structs.replace(entry, refined=None)
    if verdict.chosen == "runner_up" or verdict.ruled_out:
        changed["runner_up"] = None  # shading has decided between the two
    if result.moved:
        pose = result.after.pose(own.caster)
        label = rasterise(own.caster, result.after.camera(camera), pose).label
        changed |= {**entry_of(pose), "silhouette_iou": silhouette_iou(own.silhouette, label)}
    target = target_of(own.silhouette, own.caster.mesh.labels, 200, 0.1)
    turned = angle_between(result.after.rotation, result.before.rotation)
    moved = Moved(
        turned,
        normal_difference(*(seen_in(own.caster, target, camera, state) for state in (result.before, result.after))),
    )
    found = verdict.candidates["found"]
    candidates = {n: CandidateEntry(c.held_out_loss, *c.gain(found), c.score) for n, c in verdict.candidates.items()}
    refinement = Refinement(verdict.chosen, verdict.ruled_out, moved, candidates)
    return msgspec.structs.replace(entry, **changed, refined=refinement)
