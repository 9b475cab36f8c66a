"""Unstructured reflectance map: every pixel whose material and normal are known becomes an observation, or a sample of them.

What an observation sees past its own mesh and the photo's other objects stands in its `visibility`, and which
surfaces hide the rest in its `met`.
"""

import logging
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np

from factorlib.dataset.schema import ObjectsSlice
from factorlib.geometry.visibility import Occluders, sight
from factorlib.images.exr import read_exr
from factorlib.meshes.limits import NO_LIMITS
from factorlib.meshes.mesh import scaled
from factorlib.meshes.read import read_mesh
from factorlib.results.photos import read_photo_facts
from factorlib.results.poses import ObjectEntry, read_photo_poses
from factorlib.stage import Inputs, Progress
from factorlib.urm.extract import Taken, observations_of_photo
from factorlib.urm.merge import merge
from factorlib.urm.observations import Observations, write_observations
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
    name = inputs.photo
    light = inputs.facts["dataset.light"]
    photo, geometry = (read_exr(inputs[stage] / f"{name}.exr") for stage in ("masks", "align"))
    observations = observations_of_photo(
        photo,
        geometry,
        Taken(name, light["illumination"], read_photo_facts(inputs["masks"] / f"{name}.json").exposure),
        inputs.facts["dataset.materials"],
        params.least_confidence,
    )
    if len(observations) == 0:
        log.warning("%s: no pixel where mask and mesh agree: the photo tells nothing; see its overlay in align", name)
    observations = sample(observations, params.most)
    if params.directions and len(observations):
        observations = with_visibility(observations, photo["label"].shape, inputs, params)
    write_observations(out / f"{name}.parquet", merge(observations, params.merge_degrees))


def with_visibility(seen: Observations, shape: tuple[int, int], inputs: Inputs, params: Params) -> Observations:
    """The observations with what they see past the objects of their photo, of `shape` (height, width)."""
    found = read_photo_poses(inputs["align"] / f"{inputs.photo}.json")
    camera, occluders = found.camera.camera(shape[1], shape[0]), occluders_of(inputs, found.objects)
    past = sight(
        occluders, camera, np.column_stack([seen.x, seen.y]), seen.normal, params.directions, params.cast_points
    )
    return msgspec.structs.replace(seen, visibility=past.visibility, met=past.met) if past else seen


def occluders_of(inputs: Inputs, poses: dict[str, ObjectEntry]) -> Occluders:
    """Every object of the photo where `align` put it."""
    slice_, meshes = msgspec.convert(inputs.facts["dataset.objects"], ObjectsSlice), []
    for thing in slice_.objects:
        entry = slice_.meshes[thing.mesh]
        mesh = read_mesh(
            inputs.file(entry.file), inputs.facts["dataset.materials"], entry.made_of, thing.materials, limits=NO_LIMITS
        )
        meshes.append(scaled(mesh, poses[thing.name].scale))
    return Occluders(meshes, [poses[thing.name].pose for thing in slice_.objects])
