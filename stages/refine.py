"""Poses by shading: what silhouettes leave open, the solved materials decide.

Each pose that was found is moved by contours and shading together, and so is its runner-up.  What explains held-out pixels better
than the pose found, by a stated gain, takes its place; else the pose stays.  SET="align.poses=build/<dataset>/refine" uses it.
"""

import logging
from pathlib import Path
from typing import Annotated

import msgspec

from factorlib.align.search import normal_difference, prior_before
from factorlib.align.silhouette import silhouette_iou, silhouette_of_object
from factorlib.align.target import target_of
from factorlib.dataset.schema import ObjectsSlice
from factorlib.geometry.camera import Camera, angle_between
from factorlib.geometry.raster import Caster, rasterise
from factorlib.images.exr import read_exr
from factorlib.images.tone import straightened
from factorlib.meshes.limits import NO_LIMITS
from factorlib.meshes.mesh import scaled
from factorlib.meshes.read import read_mesh
from factorlib.refine.choice import Standards
from factorlib.refine.light import Surfaces
from factorlib.refine.materials import known_materials
from factorlib.refine.photo import PosedObject, Refined, Scene, refined_photo
from factorlib.refine.pixels import pixels_of
from factorlib.reflection import reflection_operator
from factorlib.results.materials import in_order, read_materials
from factorlib.results.photos import read_photo_facts
from factorlib.results.poses import (
    SEARCHED,
    CandidateEntry,
    Moved,
    ObjectEntry,
    PhotoPoses,
    Refinement,
    entry_of,
    read_photo_poses,
    write_photo_poses,
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
    name, file = inputs.photo, inputs["solve"] / "materials.json"
    photo, entry = read_exr(inputs["masks"] / f"{name}.exr"), read_photo_poses(inputs["align"] / f"{name}.json")
    table = read_materials(file)
    materials, known = known_materials(in_order(table, inputs.facts["dataset.materials"], file))
    if tone := table.model.tone.get(name):
        photo |= {c: straightened(photo[c], tone.exponent, tone.pivot) for c in "RGB"}
    shadows = params.directions if table.model.self_shadowing else 0
    scene = scene_of(inputs, photo, entry, shadows)
    pixels, operator = (
        pixels_of(photo, known, params.pixels, params.seed),
        reflection_operator("network", weights=inputs["train"]),
    )
    if pixels is None:
        log.warning("%s: too few pixels of known materials to tell poses by: they stay as they were found", name)
    results = refined_photo(
        scene, pixels, Surfaces(materials, operator), params, lambda done, total: progress(done, total, name)
    )
    camera, objects = entry.camera, {}
    for (own, found), each, of in zip(entry.objects.items(), results, scene.objects, strict=True):
        objects[own] = decided(found, of, each, scene.camera)
        if each.moved:
            log.warning("%s: shading moves %s by %.1f°", name, own, objects[own].refined.moved.rotation_deg)
            camera = msgspec.structs.replace(camera, focal_px=float(each.after.camera(scene.camera).focal))
    write_photo_poses(out / f"{name}.json", PhotoPoses(camera, objects))


def scene_of(inputs: Inputs, photo: dict, entry: PhotoPoses, shadows: int) -> Scene:
    """The photo as `align` left it."""
    slice_, objects = msgspec.convert(inputs.facts["dataset.objects"], ObjectsSlice), []
    for number, own in enumerate(slice_.objects, start=1):
        mesh, found = slice_.meshes[own.mesh], entry.objects[own.name]
        file = inputs.file(mesh.file)
        read = read_mesh(file, inputs.facts["dataset.materials"], mesh.made_of, own.materials, limits=NO_LIMITS)
        caster = Caster(scaled(read, found.scale))
        silhouette, other = (
            silhouette_of_object(photo, number, caster.mesh.labels, own.mask is not None),
            found.runner_up,
        )
        moves = found.source in SEARCHED
        objects.append(
            PosedObject(caster, silhouette, found.pose, other.pose if other else None, moves, not found.left_out)
        )
    height, width = photo["label"].shape
    camera, facts = entry.camera.camera(width, height), read_photo_facts(inputs["masks"] / f"{inputs.photo}.json")
    return Scene(
        camera, objects, prior_before(camera.focal, entry.camera.focal_source, facts.focal_px, width, height), shadows
    )


def decided(entry: ObjectEntry, own: PosedObject, result: Refined, camera: Camera) -> ObjectEntry:
    """The object's entry of poses.json with what shading decided."""
    verdict = result.settled
    if verdict is None:
        return msgspec.structs.replace(entry, refined=None)
    if verdict.chosen == "runner_up" or verdict.ruled_out:
        entry = msgspec.structs.replace(entry, runner_up=None)  # shading has decided between the two
    if result.moved:
        pose, seen = result.after.pose(own.caster), result.after.camera(camera)
        iou = silhouette_iou(own.silhouette, rasterise(own.caster, seen, pose).label)
        entry = msgspec.structs.replace(entry, **entry_of(pose), silhouette_iou=iou)
    target = target_of(own.silhouette, own.caster.mesh.labels, 200, 0.1)
    turned = angle_between(result.after.rotation, result.before.rotation)
    moved = Moved(turned, normal_difference(own.caster, target, camera, result.before, result.after))
    found = verdict.candidates["found"]
    candidates = {
        name: CandidateEntry(c.held_out_loss, *c.gain(found), c.score) for name, c in verdict.candidates.items()
    }
    return msgspec.structs.replace(entry, refined=Refinement(verdict.chosen, verdict.ruled_out, moved, candidates))
