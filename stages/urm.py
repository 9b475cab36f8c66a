"""Unstructured reflectance map: every pixel whose material and normal are known becomes an observation, or a sample of them.

What an observation sees past its own mesh and the photo's other objects stands in its `visibility`, and which
surfaces hide the rest in its `met`.
"""

import logging
from functools import partial
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np

from factorlib.dataset.schema import ObjectsSlice
from factorlib.geometry.visibility import Occluders, sight
from factorlib.images.exr import read_exr
from factorlib.meshes.mesh import scaled
from factorlib.meshes.read import CREASE_DEG, MeshesOnce
from factorlib.results.photos import read_photo_facts
from factorlib.results.poses import ObjectEntry, read_photo_poses
from factorlib.stage import Inputs, Progress
from factorlib.urm.extract import Taken, observations_of_photo
from factorlib.urm.merge import merge
from factorlib.urm.observations import write_observations
from factorlib.urm.sample import sample

log = logging.getLogger("factorlib.urm")


class Params(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Which pixels become observations, and what they see of the sphere."""

    merge_degrees: Annotated[float, msgspec.Meta(ge=0, le=30)] = 0.0
    """Pixels of one material whose normals and views differ by less, in degrees, become one observation; 0 keeps every pixel."""
    least_confidence: Annotated[float, msgspec.Meta(ge=0, lt=1)] = 0.0
    """Least confidence that `align` gives a pixel for it to be observed."""
    most: Annotated[int, msgspec.Meta(ge=5000)] = 100_000
    """Most observations of a photo; of more, a sample is taken, evenly over materials and normals, and weighted."""
    directions: Annotated[int, msgspec.Meta(ge=0, le=4096)] = 512
    """Directions of the sphere whose visibility is cast; 0 for none."""
    cast_points: Annotated[int, msgspec.Meta(ge=100)] = 25_000
    """Observations of a photo that rays are cast from; the others take their neighbours' visibility."""


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Write the observations of one photo."""
    name, facts = inputs.photo, inputs.facts
    photo, geometry = (read_exr(inputs[stage] / f"{name}.exr") for stage in ("masks", "align"))
    exposure = read_photo_facts(inputs["masks"] / f"{name}.json").exposure
    taken = Taken(name, facts["dataset.light"]["illumination"], exposure)
    seen = observations_of_photo(photo, geometry, taken, facts["dataset.materials"], params.least_confidence)
    if len(seen) == 0:
        log.warning("%s: no pixel where mask and mesh agree: the photo tells nothing; see its overlay in align", name)
    seen = sample(seen, params.most)
    if params.directions and len(seen):
        poses, (height, width) = read_photo_poses(inputs["align"] / f"{name}.json"), photo["label"].shape
        occluders, pixels = occluders_of(inputs, poses.objects), np.column_stack([seen.x, seen.y])
        camera = poses.camera.camera(width, height)
        report = partial(progress, text=f"{name}: visibility")
        past = sight(occluders, camera, pixels, seen.normal, params.directions, params.cast_points, report)
        if past:
            seen = msgspec.structs.replace(seen, visibility=past.visibility, met=past.met)
    write_observations(out / f"{name}.parquet", merge(seen, params.merge_degrees))


def occluders_of(inputs: Inputs, poses: dict[str, ObjectEntry]) -> Occluders:
    """Every object of the photo where `align` put it."""
    slice_ = msgspec.convert(inputs.facts["dataset.objects"], ObjectsSlice)
    read = MeshesOnce(inputs.mesh, inputs.facts["dataset.materials"], CREASE_DEG)
    meshes = [read.mesh(own.mesh, slice_.meshes[own.mesh], own.materials) for own in slice_.objects]
    placed = [poses[own.name] for own in slice_.objects]
    return Occluders([scaled(mesh, at.scale) for mesh, at in zip(meshes, placed)], [at.pose for at in placed])
