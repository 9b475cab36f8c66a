"""Surface detail by shading: normals and albedo factors that differ from the meshes as given, from all photos together.

Materials and lights are fitted as at the start of the solve.  Normals then turn to explain all photos best, and the
turns are kept only if they improve held-out photos (`factorlib.inference.surface.surface_detail`).  Factors on the
diffuse reflectance are chosen likewise, in addition to the turns.

Where photos show more lights than `Params.lights`, the ones that tell most of the materials are selected here, for
`solve` as well (`factorlib.inference.surface.light_selection`).

Writes surface.json, and beginning.json: materials and lights of the first fit, from which `solve` continues.  If
surfaces differ, it writes photos/<photo>.exr: normals, which later stages use instead of those of `align`, and factors.
"""

from collections import defaultdict
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import numpy as np

from factorlib.dataset.schema import LightSlice, ObjectsSlice, solved_photos
from factorlib.errors import InputError
from factorlib.images.exr import write_exr
from factorlib.inference.fit.start import start_from_photos
from factorlib.inference.model.blocks import Noise
from factorlib.inference.model.observed import blocks_of_observations, read_backgrounds, usable_observations
from factorlib.inference.model.problem import JointProblem
from factorlib.inference.surface.aligned_photo import AlignedPhoto, read_aligned_photos, visible_meshes
from factorlib.inference.surface.light_selection import Counts, count_by_side, select_lights
from factorlib.inference.surface.surface_detail import SurfaceEstimate, estimate_surface
from factorlib.inference.surface.surface_turns import (
    SurfacePositions,
    Surfaces,
    concatenate_positions,
    zero_detail,
)
from factorlib.jsonfile import write_json
from factorlib.meshes.read_mesh import CREASE_DEG, MeshCache
from factorlib.meshes.subdivision import subdivided_mesh
from factorlib.reflection import reflection_operator
from factorlib.results.surface_table import BEGINNING, FILE, DetailEvidence, SurfaceTable
from factorlib.stage import Inputs, Progress
from factorlib.urm.observations import (
    Observations,
    at_one_exposure,
    concatenate,
    read_observations,
    relative_exposures,
)


class Params(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Choice of surface detail, and the observations it is estimated from."""

    shape: Literal["auto", "off"] = "auto"
    """Normals and albedo factors by shading; auto: used if they improve held-out photos."""
    observations: Annotated[int, msgspec.Meta(ge=200)] = 2000
    """Number of a photo's observations, drawn at random, that turns are estimated from."""
    lights: Annotated[int, msgspec.Meta(ge=1)] = 16
    """Largest number of lights that surface and materials are estimated from.  Further lights are fitted one by one,
    given the materials."""
    seed: Annotated[int, msgspec.Meta(ge=0)] = 0
    """Seed of the observations that are drawn and of those that are held out."""


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Estimate the surface detail of all meshes, and write it if it is kept."""
    slices = msgspec.convert(inputs.facts["dataset.objects"], dict[str, ObjectsSlice])
    photos = read_aligned_photos(inputs, slices)
    lights = msgspec.convert(inputs.facts["dataset.light"], dict[str, LightSlice])
    solved = {name: photos[name] for name in sorted(solved_photos(lights))}
    observations = {name: draw_observations(inputs["urm"] / f"{name}.parquet", params) for name in solved}
    refuse_left_out(solved, observations)
    counts = defaultdict[str, Counts](Counts)
    for name, pixels in observations.items():
        counts[lights[name].illumination] += count_by_side(photos[name], pixels)
    selected = select_lights(counts, params.lights) if len(counts) > params.lights else None
    unchanged = SurfaceTable(lights=selected)
    read = MeshCache(inputs.mesh, inputs.facts["dataset.materials"], CREASE_DEG)
    meshes = visible_meshes(read, slices) if params.shape != "off" else {}
    if not meshes:
        write_json(out / FILE, unchanged)
        return
    surfaces = Surfaces({name: subdivided_mesh(mesh) for name, mesh in meshes.items()})
    if selected is not None:
        observations = {name: o for name, o in observations.items() if lights[name].illumination in selected}
    attached = {
        name: photos[name].attach(np.column_stack([pixels.x, pixels.y]), surfaces)
        for name, pixels in observations.items()
    }
    result = _estimate_surface(params, inputs, observations, attached, surfaces, progress)
    displacements, factors = (
        {name: values.astype("f4") for name, values in values_by_mesh.items()}
        for values_by_mesh in (result.displacements, result.log_factors)
    )
    # turns of normals and log albedo factors at the nodes of all meshes
    detail = zero_detail(surfaces.nodes)
    if displacements:
        detail = msgspec.structs.replace(detail, turn=surfaces.turns_from_displacements(displacements))
    if factors:
        detail = msgspec.structs.replace(detail, log_factor=np.concatenate([factors[name] for name in surfaces.meshes]))
    if displacements or factors:
        (out / "photos").mkdir()
        for name, photo in photos.items():
            write_exr(out / "photos" / f"{name}.exr", photo.detail_channels(surfaces, detail))
    table = SurfaceTable(
        bool(displacements),
        DetailEvidence.from_decision(result.evidence, result.stiffness.turn),
        bool(factors),
        DetailEvidence.from_decision(result.painted, result.stiffness.factor),
        result.gains,
        {name: values.tolist() for name, values in displacements.items()},
        {name: values.tolist() for name, values in factors.items()},
        selected,
    )
    write_json(out / FILE, table)
    write_json(out / BEGINNING, result.beginning)
    progress(1, 1)


def refuse_left_out(photos: dict[str, AlignedPhoto], observations: dict[str, Observations]) -> None:
    """Raise InputError if no photo has an observation and doubtful poses were left out; it names these."""
    left_out = [f"'{each}' in '{name}'" for name, photo in photos.items() for each in photo.poses.left_out]
    if left_out and not any(map(len, observations.values())):
        raise InputError(
            "no valid observation in any photo, for doubtful poses are left out: " + ", ".join(left_out),
            cure='look at their overlays in `align`; where they are right, SET="align.keep_doubtful=true" lets them in',
        )


def draw_observations(file: Path, params: Params) -> Observations:
    """Return at most `params.observations` usable observations of a photo, drawn at random, in their order."""
    usable = usable_observations(read_observations(file))
    rows = np.random.default_rng(params.seed).permutation(len(usable))[: params.observations]
    return usable.take(np.sort(rows))


def _estimate_surface(
    params: Params,
    inputs: Inputs,
    observations: dict[str, Observations],
    attached: dict[str, SurfacePositions],
    surfaces: Surfaces,
    progress: Progress,
) -> SurfaceEstimate:
    """Return the surface detail estimated from all photos.

    Args:
        params: Parameters of the stage.
        inputs: Inputs of the stage.
        observations: Observations, by photo.
        attached: Nodes under the observations, by photo.
        surfaces: Subdivided meshes.
        progress: Called with the completed work, its total and the current activity.
    """
    lights = msgspec.convert(inputs.facts["dataset.light"], dict[str, LightSlice])
    worlds = {
        name: np.array(light.world_from_camera) for name, light in lights.items() if light.world_from_camera is not None
    }
    merged = concatenate(list(observations.values()))
    relative = relative_exposures(merged)
    backgrounds = read_backgrounds(inputs["urm"], relative)
    blocks = blocks_of_observations(
        at_one_exposure(merged, relative), Noise(), world_from_camera=worlds, seed=params.seed, backgrounds=backgrounds
    )
    in_frame = [light.rotate(worlds.get(name, np.eye(3))) for name, light in attached.items()]
    problem = JointProblem(blocks, reflection_operator("network", weights=inputs["train"]), spread=inputs.map)
    nodes = concatenate_positions(in_frame)
    positions = []
    for block in blocks:
        assert block.row is not None  # `blocks_of_observations` numbers the observations
        positions.append(nodes.take(block.row))
    return estimate_surface(
        problem,
        surfaces,
        positions,
        start_from_photos(len(inputs.facts["dataset.materials"])),
        params.seed,
        lambda share, activity: progress(share, 1, activity),
    )
