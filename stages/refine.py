"""Poses by shading: what silhouettes leave open, the solved materials decide.

Each pose that was found is moved by contours and shading together, and so is its runner-up.  What explains held-out pixels better
than the pose found, by a stated gain, takes its place; else the pose stays.  SET="align.poses=build/<dataset>/refine" uses it.
"""

import logging
from pathlib import Path
from typing import Annotated

import msgspec

from factorlib.align.camera import Camera, angle_between
from factorlib.align.earlier import SEARCHED, EarlierPhoto
from factorlib.align.evidence import object_evidence, silhouette_iou
from factorlib.align.raster import Caster, rasterise
from factorlib.align.search import normal_difference, prior_before
from factorlib.align.target import target_of
from factorlib.dataset.schema import ObjectsSlice
from factorlib.images.exr import read_exr
from factorlib.images.tone import straightened
from factorlib.jsonfile import read_json, write_json
from factorlib.meshes.limits import NO_LIMITS
from factorlib.meshes.mesh import scaled
from factorlib.meshes.read import read_mesh
from factorlib.refine.choice import Standards
from factorlib.refine.light import Surfaces
from factorlib.refine.materials import known_materials
from factorlib.refine.photo import PosedObject, Refined, Scene, refined_photo
from factorlib.refine.pixels import pixels_of
from factorlib.reflection import reflection_operator
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
    name, table = inputs.photo, inputs["solve"] / "materials.json"
    photo, entry = read_exr(inputs["masks"] / f"{name}.exr"), read_json(inputs["align"] / f"{name}.json")
    materials, known = known_materials(table, inputs.facts["dataset.materials"])
    model = read_json(table)["model"]
    if tone := model.get("tone", {}).get(name):
        photo |= {c: straightened(photo[c], **tone) for c in "RGB"}
    shadows = params.directions if model.get("self_shadowing") else 0
    scene = scene_of(inputs, photo, entry, shadows)
    pixels, operator = pixels_of(photo, known, params.pixels, params.seed), reflection_operator("network", weights=inputs["train"])
    if pixels is None:
        log.warning("%s: too few pixels of known materials to tell poses by: they stay as they were found", name)
    results = refined_photo(scene, pixels, Surfaces(materials, operator), params, lambda done, total: progress(done, total, name))
    for (own, said), each, of in zip(entry["objects"].items(), results, scene.objects, strict=True):
        said |= decided(of, each, scene.camera)
        if each.moved:
            log.warning("%s: shading moves %s by %.1f°", name, own, said["refined"]["moved"]["rotation_deg"])
            entry["camera"]["focal_px"] = float(each.after.camera(scene.camera).focal)
    write_json(out / f"{name}.json", entry)


def scene_of(inputs: Inputs, photo: dict, entry: dict, shadows: int) -> Scene:
    """The photo as `align` left it."""
    slice_, found = msgspec.convert(inputs.facts["dataset.objects"], ObjectsSlice), msgspec.convert(entry, EarlierPhoto)
    objects = []
    for number, own in enumerate(slice_.objects, start=1):
        mesh, said, pose = slice_.meshes[own.mesh], entry["objects"][own.name], found.objects[own.name]
        file = inputs.file(mesh.file)
        read = read_mesh(file, inputs.facts["dataset.materials"], mesh.parts, mesh.material, own.materials, limits=NO_LIMITS)
        caster = Caster(scaled(read, pose.scale))
        evidence, other = object_evidence(photo, number, caster.mesh.labels, own.mask is not None), pose.runner_up
        moves = said["source"] in SEARCHED
        objects.append(PosedObject(caster, evidence, pose.pose(), other.pose() if other else None, moves, not said["left_out"]))
    height, width = photo["label"].shape
    camera = Camera(width, height, entry["camera"]["focal_px"], tuple(entry["camera"]["principal_point"]))
    facts = read_json(inputs["masks"] / f"{inputs.photo}.json")
    return Scene(camera, objects, prior_before(camera.focal, entry["camera"]["focal_source"], facts["focal_px"], width, height), shadows)


def decided(own: PosedObject, result: Refined, camera: Camera) -> dict:
    """What changes in the object's entry of poses.json, and in `refined` what decided."""
    entry, verdict = {}, result.settled
    if verdict is None:
        return {"refined": None}
    if verdict.chosen == "runner_up" or verdict.ruled_out:
        entry["runner_up"] = None  # shading has decided between the two
    if result.moved:
        pose, seen = result.after.pose(own.caster), result.after.camera(camera)
        entry |= {"rotation": pose.rotation.tolist(), "translation": pose.translation.tolist()}
        entry["silhouette_iou"] = silhouette_iou(own.evidence, rasterise(own.caster, seen, pose).label)
    target = target_of(own.evidence, own.caster.mesh.labels, 200, 0.1)
    moved = {
        "rotation_deg": angle_between(result.after.rotation, result.before.rotation),
        "normals_deg": normal_difference(own.caster, target, camera, result.before, result.after),
    }
    candidates = {}
    for name, c in verdict.candidates.items():
        gain, stderr = c.gain(verdict.candidates["found"])
        candidates[name] = {"held_out_loss": c.held_out_loss, "gain": gain, "gain_stderr": stderr, "score": c.score}
    evidence = {"chosen": verdict.chosen, "runner_up_ruled_out": verdict.ruled_out, "moved": moved, "candidates": candidates}
    return entry | {"refined": evidence}
