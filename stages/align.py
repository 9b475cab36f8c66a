"""Where the meshes are in each photo, and what every pixel sees of them: normals, view directions, depth, labels."""

import logging
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np

from factorlib.align.camera import Camera, Pose
from factorlib.align.confidence import confidence
from factorlib.align.evidence import label_agreement, object_evidence, silhouette_iou, whole_evidence
from factorlib.align.overlay import overlay
from factorlib.align.raster import Caster, Maps, rasterise
from factorlib.dataset import schema
from factorlib.errors import InputError
from factorlib.images.exr import read_exr, write_exr
from factorlib.images.picture import write_png
from factorlib.jsonfile import read_json, write_json
from factorlib.meshes.read import CREASE_DEG, read_mesh
from factorlib.stage import Inputs, Progress

log = logging.getLogger("factorlib.align")


class Params(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    crease_deg: Annotated[float, msgspec.Meta(gt=0, le=180)] = CREASE_DEG
    least_iou: Annotated[float, msgspec.Meta(ge=0, le=1)] = 0.8  # below: a warning, or an error if strict
    strict: bool = False


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    name = inputs.photo
    photo = msgspec.convert(inputs.facts["dataset.objects"], schema.ObjectsSlice)
    channels, facts = read_exr(inputs["masks"] / f"{name}.exr"), read_json(inputs["masks"] / f"{name}.json")
    casters = [caster_of(thing, photo, inputs, params) for thing in photo.objects]
    camera, poses = given(photo, facts, name)
    maps = rasterise(casters, camera, poses)
    write_maps(out / f"{name}.exr", maps, confidence(maps, whole_evidence(channels)))
    radiance = np.stack([channels[c] for c in "RGB"], axis=-1)
    write_png(out / f"{name}_overlay.png", overlay(radiance, maps, whole_evidence(channels)))
    objects = {}
    for number, (thing, caster, pose) in enumerate(zip(photo.objects, casters, poses), start=1):
        evidence = object_evidence(channels, number, caster.mesh.labels, thing.mask is not None)
        seen = np.where(maps.object == number, maps.label, 0)
        objects[thing.name] = {
            "rotation": pose.rotation.tolist(),
            "translation": pose.translation.tolist(),
            "silhouette_iou": silhouette_iou(evidence, seen),
            "label_agreement": label_agreement(evidence, seen),
        }
    write_json(out / f"{name}.json", {"camera": {"focal_px": camera.focal, "principal_point": [float(c) for c in camera.centre]}, "objects": objects})


def given(photo: schema.ObjectsSlice, facts: dict, name: str) -> tuple[Camera, list[Pose]]:
    if any(thing.pose is None for thing in photo.objects) or not facts["focal_px"]:
        raise InputError("a pose and a focal length are needed", file="dataset.yaml", key=name, cure="give both")
    centre = photo.camera.principal_point or (facts["width"] / 2, facts["height"] / 2)
    camera = Camera(facts["width"], facts["height"], facts["focal_px"], tuple(centre))
    return camera, [Pose(np.array(t.pose.rotation), np.array(t.pose.translation)) for t in photo.objects]


def caster_of(thing: schema.ObjectEntry, photo: schema.ObjectsSlice, inputs: Inputs, params: Params) -> Caster:
    mesh = photo.meshes[thing.mesh]
    materials = inputs.facts["dataset.materials"]
    return Caster(read_mesh(inputs.file(mesh.file), materials, mesh.parts, mesh.material, thing.materials, params.crease_deg))


def write_maps(path: Path, maps: Maps, certainty: np.ndarray) -> None:
    channels = {f"normal.{a}": maps.normal[..., k] for k, a in enumerate("xyz")}
    channels |= {f"view.{a}": maps.view[..., k] for k, a in enumerate("xyz")}
    channels |= {"depth": maps.depth, "label": maps.label, "object": maps.object, "confidence": certainty, "back": maps.back}
    write_exr(path, channels)
