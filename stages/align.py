"""Where the meshes are in each photo, and what every pixel sees of them: normals, view directions, depth, labels."""

import logging
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np

from factorlib.align.camera import Camera, Pose
from factorlib.align.confidence import confidence
from factorlib.align.doubts import Standards, doubts
from factorlib.align.evidence import label_agreement, object_evidence, silhouette_iou, whole_evidence
from factorlib.align.overlay import overlay
from factorlib.align.place import Placed, Thing, placed
from factorlib.align.raster import Caster, Maps, rasterise
from factorlib.align.search import Found, Search
from factorlib.dataset import schema
from factorlib.errors import InputError
from factorlib.images.exr import read_exr, write_exr
from factorlib.images.picture import write_png
from factorlib.jsonfile import read_json, write_json
from factorlib.meshes.read import CREASE_DEG, read_mesh
from factorlib.stage import Inputs, Progress

log = logging.getLogger("factorlib.align")
CURE = "look at its overlay; give the object's pose, or the photo's camera.focal_px, in dataset.yaml"


class Params(Standards, frozen=True, forbid_unknown_fields=True):
    crease_deg: Annotated[float, msgspec.Meta(gt=0, le=180)] = CREASE_DEG  # sharper edges of a mesh stay sharp
    strict: bool = False  # stop at a doubtful pose
    search: Search = Search()


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    name = inputs.photo
    slice_ = msgspec.convert(inputs.facts["dataset.objects"], schema.ObjectsSlice)
    channels, facts = read_exr(inputs["masks"] / f"{name}.exr"), read_json(inputs["masks"] / f"{name}.json")
    things = things_of(slice_, channels, inputs, params)
    result = placed(things, camera_of(slice_.camera, facts), facts["focal_px"], facts["focal_source"], name, params.search)
    maps = rasterise([thing.caster for thing in things], result.camera, result.poses)
    whole = whole_evidence(channels)
    write_maps(out / f"{name}.exr", maps, confidence(maps, whole))
    write_png(out / f"{name}_overlay.png", overlay(np.stack([channels[c] for c in "RGB"], axis=-1), maps, whole))
    objects = {thing.name: entry(thing, k, result, maps, params) for k, thing in enumerate(things)}
    for thing_name, facts_of_it in objects.items():
        complain(name, thing_name, facts_of_it, params.strict)
    write_json(out / f"{name}.json", {"camera": camera_entry(result), "objects": objects})


def things_of(slice_: schema.ObjectsSlice, channels: dict, inputs: Inputs, params: Params) -> list[Thing]:
    things = []
    for number, thing in enumerate(slice_.objects, start=1):
        mesh, materials = slice_.meshes[thing.mesh], inputs.facts["dataset.materials"]
        file = inputs.file(mesh.file)
        caster = Caster(read_mesh(file, materials, mesh.parts, mesh.material, thing.materials, params.crease_deg))
        evidence = object_evidence(channels, number, caster.mesh.labels, thing.mask is not None)
        pose = Pose(np.array(thing.pose.rotation), np.array(thing.pose.translation)) if thing.pose else None
        things.append(Thing(thing.name, caster, evidence, pose))
    return things


def camera_of(given: schema.Camera, facts: dict) -> Camera:
    """The photo's camera, principal point in the middle unless given; its focal length is settled later."""
    centre = given.principal_point or (facts["width"] / 2, facts["height"] / 2)
    return Camera(facts["width"], facts["height"], 1.0, tuple(centre))


def camera_entry(result: Placed) -> dict:
    camera = result.camera
    return {
        "focal_px": float(camera.focal),
        "focal_source": result.focal_source,
        "focal_relative_stderr": result.log_focal_sigma,
        "principal_point": [float(c) for c in camera.centre],
    }


def entry(thing: Thing, k: int, result: Placed, maps: Maps, params: Params) -> dict:
    """What poses.json says of one object; `doubts` is empty for a pose to be believed."""
    seen = np.where(maps.object == k + 1, maps.label, 0)
    iou, agreement = silhouette_iou(thing.evidence, seen), label_agreement(thing.evidence, seen)
    found, pose = result.found[k], result.poses[k]
    return {
        "rotation": pose.rotation.tolist(),
        "translation": pose.translation.tolist(),
        "silhouette_iou": iou,
        "label_agreement": agreement,
        "source": "given" if found is None else "found",
        "score": found.score if found else None,
        "runner_up": runner_up_entry(found),
        "doubts": doubts(iou, agreement, found, params),
    }


def runner_up_entry(found: Found | None) -> dict | None:
    if found is None or found.runner_up is None:
        return None
    other = found.runner_up
    return {"rotation": other.state.rotation.tolist(), "score": other.score, "normal_difference_deg": other.normal_difference_deg}


def complain(photo: str, thing: str, facts: dict, strict: bool) -> None:
    for reason in facts["doubts"]:
        if strict:
            raise InputError(reason, file="dataset.yaml", key=f"{photo}.{thing}", cure=CURE)
        log.warning("%s: %s: %s; %s", photo, thing, reason, CURE)


def write_maps(path: Path, maps: Maps, certainty: np.ndarray) -> None:
    channels = {f"normal.{a}": maps.normal[..., k] for k, a in enumerate("xyz")}
    channels |= {f"view.{a}": maps.view[..., k] for k, a in enumerate("xyz")}
    channels |= {"depth": maps.depth, "label": maps.label, "object": maps.object, "confidence": certainty, "back": maps.back}
    write_exr(path, channels)
