"""Unstructured reflectance map (URM): observations of one photo, from pixels with a known material and normal.

Observations also have `visibility`, the share of light that arrives from each direction past the photo's meshes, and
`met`, the surfaces that hide the rest.  Writes <photo>.parquet; background/<photo>.exr, the radiance of the
surroundings where the photo shows them, by direction from the objects; and ground/<photo>.parquet, the shadows on the
ground, if it is even.
"""

import logging
from functools import partial
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np

from factorlib.dataset.schema import GroundSlice, ObjectsSlice
from factorlib.geometry.ground import Plane, resting_plane
from factorlib.geometry.occlusion import Occluders
from factorlib.images.exr import LAT_LONG, read_exr, write_rgb_exr
from factorlib.meshes.mesh import Mesh
from factorlib.meshes.read_mesh import CREASE_DEG, MeshCache
from factorlib.results.photos import read_photo_facts
from factorlib.results.poses import ObjectPose, read_photo_poses
from factorlib.stage import Inputs, Progress
from factorlib.urm.background import surrounding_radiance
from factorlib.urm.cast_shadows import GroundView, ground_observations
from factorlib.urm.extract import PhotoSource, extract_observations, surface_centre
from factorlib.urm.observations import write_observations
from factorlib.urm.reduction import merge, sample

log = logging.getLogger("factorlib.urm")


# Largest distance of an object from the ground of its photo, in its own extents.  Estimated poses of chairs on one
# floor are up to 0.03 apart.
MOST_HEIGHT = 0.05


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
    poses = read_photo_poses(inputs["align"] / f"{name}.json")
    height, width = photo["label"].shape
    camera = poses.camera.camera(width, height)
    meshes = read_meshes(inputs)
    ground = ground_plane(inputs, meshes, poses.objects)
    background = surrounding_radiance(photo, camera, surface_centre(geometry), ground)
    (out / "background").mkdir(exist_ok=True)  # one folder for all photos, outside the runner
    write_rgb_exr(out / "background" / f"{name}.exr", background, LAT_LONG)
    # visibility: rays from observations past all meshes of the photo
    if params.directions and len(observations):
        occluders = Occluders(list(meshes.values()), [poses.objects[each].pose for each in meshes])
        if ground is not None:
            view = GroundView(camera, ground, occluders)
            shadows = ground_observations(photo, geometry, view, observations, params.directions)
            if shadows is not None:
                (out / "ground").mkdir(exist_ok=True)
                write_observations(out / "ground" / f"{name}.parquet", shadows)
        visibility = occluders.visibility_at(
            camera,
            np.column_stack([observations.x, observations.y]),
            observations.normal,
            params.directions,
            params.cast_points,
            partial(progress, text=f"{name}: visibility"),
        )
        if visibility:
            observations = msgspec.structs.replace(observations, **msgspec.structs.asdict(visibility))
    write_observations(out / f"{name}.parquet", merge(observations, params.merge_degrees))


def read_meshes(inputs: Inputs) -> dict[str, Mesh]:
    """Read the meshes of the photo's objects, by object."""
    slice_ = msgspec.convert(inputs.facts["dataset.objects"], ObjectsSlice)
    read = MeshCache(inputs.mesh, inputs.facts["dataset.materials"], CREASE_DEG)
    return {obj.name: read.mesh(obj.mesh, slice_.meshes[obj.mesh], obj.materials) for obj in slice_.objects}


def ground_plane(inputs: Inputs, meshes: dict[str, Mesh], poses: dict[str, ObjectPose]) -> Plane | None:
    """Return the ground of dataset.yaml, or else the lowest plane on which an object rests, in the camera's frame.

    Objects of a photo stand on one ground: None if one of them hovers over that plane, or sinks into it.
    """
    given = msgspec.convert(inputs.facts["dataset.ground"], GroundSlice).ground
    if given is not None:
        normal = np.array(given.normal)
        return Plane(normal / np.linalg.norm(normal), np.array(given.point))
    placed = {name: poses[name].pose.apply(mesh.vertices) for name, mesh in meshes.items()}
    planes = []
    for name, mesh in meshes.items():
        rotation = poses[name].pose.rotation
        upright = rotation.T @ [0.0, -1.0, 0.0]
        planes.append(resting_plane(mesh.vertices, placed[name], rotation, upright[None]))
    resting = [plane for plane in planes if plane is not None]
    if not resting:
        return None
    ground = min(resting, key=lambda plane: plane.point @ resting[0].normal)
    for vertices in placed.values():
        height = ((vertices - ground.point) @ ground.normal).min()
        if abs(height) > MOST_HEIGHT * np.linalg.norm(np.ptp(vertices, axis=0)):
            return None
    return ground
