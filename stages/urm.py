"""Unstructured reflectance map (URM): observations of one photo, from pixels with a known material and normal.

Observations also have `visibility`, the share of light that arrives from each direction past the photo's meshes, and
`met`, the surfaces that hide the rest.  Writes <photo>.parquet.
"""

import logging
from functools import partial
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np

from factorlib.dataset.schema import ObjectsSlice
from factorlib.geometry.occlusion import Occluders
from factorlib.images.exr import read_exr
from factorlib.meshes.mesh import scale_mesh
from factorlib.meshes.read_mesh import CREASE_DEG, MeshCache
from factorlib.results.photos import read_photo_facts
from factorlib.results.poses import ObjectPose, read_photo_poses
from factorlib.stage import Inputs, Progress
from factorlib.urm.extract import PhotoSource, extract_observations
from factorlib.urm.observations import write_observations
from factorlib.urm.reduction import merge, sample

log = logging.getLogger("factorlib.urm")


class Params(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Selection of pixels, and resolution of visibility."""

    merge_degrees: Annotated[float, msgspec.Meta(ge=0, le=30)] = 0.0
    """Angle, in degrees.  Pixels of one material whose normals and views differ by less are merged; 0 merges none."""
    least_confidence: Annotated[float, msgspec.Meta(ge=0, lt=1)] = 0.0
    """Smallest confidence, 0 to 1 as computed by `align`, of a pixel that becomes an observation."""
    most: Annotated[int, msgspec.Meta(ge=5000)] = 100_000
    """Largest number of a photo's observations.  More are sampled evenly over materials and normals, and weighted."""
    directions: Annotated[int, msgspec.Meta(ge=0, le=4096)] = 512
    """Directions of the sphere whose visibility is computed (their number); 0 for none."""
    cast_points: Annotated[int, msgspec.Meta(ge=100)] = 25_000
    """Number of a photo's observations from which rays are cast; the others take the visibility of neighbours."""


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Write the observations of one photo."""
    name = inputs.photo
    assert name is not None  # a stage over one photo
    facts = inputs.facts
    photo, geometry = (read_exr(inputs[stage] / f"{name}.exr") for stage in ("masks", "align"))
    exposure = read_photo_facts(inputs["masks"] / f"{name}.json").exposure
    source = PhotoSource(name, facts["dataset.light"]["illumination"], exposure)
    materials = facts["dataset.materials"]
    observations = extract_observations(photo, geometry, source, materials, params.least_confidence)
    if len(observations) == 0:
        log.warning("%s: no pixel where mask and mesh agree: the photo tells nothing; see its overlay in align", name)
    observations = sample(observations, params.most)
    # visibility: rays from observations past all meshes of the photo
    if params.directions and len(observations):
        poses = read_photo_poses(inputs["align"] / f"{name}.json")
        height, width = photo["label"].shape
        visibility = read_occluders(inputs, poses.objects).visibility_at(
            poses.camera.camera(width, height),
            np.column_stack([observations.x, observations.y]),
            observations.normal,
            params.directions,
            params.cast_points,
            partial(progress, text=f"{name}: visibility"),
        )
        if visibility:
            observations = msgspec.structs.replace(observations, **msgspec.structs.asdict(visibility))
    write_observations(out / f"{name}.parquet", merge(observations, params.merge_degrees))


def read_occluders(inputs: Inputs, poses: dict[str, ObjectPose]) -> Occluders:
    """Read the meshes of the photo's objects, at the poses that `align` estimated."""
    slice_ = msgspec.convert(inputs.facts["dataset.objects"], ObjectsSlice)
    read = MeshCache(inputs.mesh, inputs.facts["dataset.materials"], CREASE_DEG)
    entries = [poses[obj.name] for obj in slice_.objects]
    meshes = [read.mesh(obj.mesh, slice_.meshes[obj.mesh], obj.materials) for obj in slice_.objects]
    scaled_meshes = [scale_mesh(mesh, entry.scale) for mesh, entry in zip(meshes, entries)]
    return Occluders(scaled_meshes, [entry.pose for entry in entries])
