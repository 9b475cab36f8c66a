"""What was solved, in the forms that other programs read.

Writes illumination/<light>.exr and .hdr, coverage/<light>.exr, materials.json, lobes.parquet and exposures.json in the gauge that
Mitsuba needs, scenes/<photo>.xml with their meshes and lights, the same scenes for Blender and as OpenUSD, materials.mtlx and <mesh>.glb,
and losses.json: what is lost on the way to other programs.
"""

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
import OpenImageIO as oiio

from factorlib.conventions import lat_long_directions
from factorlib.dataset import schema
from factorlib.dataset.schema import LightSlice, MeshEntry, ObjectsSlice
from factorlib.export.blender import ExposedMap, write_scene_json, write_script
from factorlib.export.environment import mitsuba_map
from factorlib.export.gltf import write_glb
from factorlib.export.loss import write_losses
from factorlib.export.materials import headroom_factor, table_in_gauge
from factorlib.export.materialx import write_materialx
from factorlib.export.mitsuba import ALL_BOUNCES, DIRECT, Environment, Shape, View, write_scene
from factorlib.export.usd import SUFFIX, write_usd_mesh, write_usd_scene
from factorlib.images.exr import LAT_LONG, read_rgb_exr, write_rgb_exr
from factorlib.images.write import write_hdr
from factorlib.jsonfile import write_json
from factorlib.light.latlong import lat_long_of_lobes, sampled
from factorlib.light.lobes import Lobes, no_lobes
from factorlib.meshes.ply import submesh, write_ply
from factorlib.meshes.read import CREASE_DEG, MeshesOnce
from factorlib.results.lobes import read_lobes, write_lobes
from factorlib.results.materials import read_exposures, read_materials, reflectances
from factorlib.results.poses import ObjectEntry, read_poses
from factorlib.stage import Inputs, Progress

log = logging.getLogger("factorlib.export")
Rows = Annotated[int, msgspec.Meta(ge=8, le=4096)]


class Params(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Sizes of what is written, and how meshes are read."""

    height: Rows = 128
    """Rows of the exported environment maps, which are twice as wide."""
    mitsuba_height: Rows = 256
    """Rows of the environment maps in the Mitsuba scenes."""
    crease_deg: Annotated[float, msgspec.Meta(gt=0, le=180)] = CREASE_DEG
    """Angle, in degrees, between the normals of two triangles above which the edge between them stays sharp."""


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Write materials, lights, coverage and scenes in the forms of other programs."""
    names, solved = inputs.facts["dataset.materials"], inputs["solve"]
    lights = msgspec.convert(inputs.facts["dataset.light"], dict[str, LightSlice])
    objects = msgspec.convert(inputs.facts["dataset.objects"], dict[str, ObjectsSlice])
    progress(0, 4, "materials")
    table, exposures = read_materials(solved / "materials.json"), read_exposures(solved / "exposures.json")
    factor = headroom_factor(table.materials)
    table = table_in_gauge(table, factor)
    materials = reflectances(table)
    # the factor that leaves the materials enters the lights
    lobes = {n: light.scaled(1 / factor) for n, light in _solved_lights(solved / "lobes.parquet", lights).items()}
    write_json(out / "materials.json", table)
    write_json(out / "exposures.json", exposures)
    write_lobes(out / "lobes.parquet", lobes)
    write_materialx(out / "materials.mtlx", materials)
    write_losses(out / "losses.json", materials)
    progress(1, 4, "lights")
    for folder in ("illumination", "coverage", "scenes/light", "scenes/meshes"):
        (out / folder).mkdir(parents=True)
    for name, light in lobes.items():
        _write_light(out, name, light, solved / "coverage" / f"{name}.exr", params)
    progress(2, 4, "meshes")
    files = MeshFiles(inputs, out / "scenes", names, params.crease_deg)
    for name, mesh in sorted({n: m for each in objects.values() for n, m in each.meshes.items()}.items()):
        write_glb(out / f"{name}.glb", files.read.mesh(name, mesh), names, materials)
    progress(3, 4, "scenes")
    write_script(out / "scenes")
    poses = read_poses(inputs["align"] / "poses.json")
    max_depth = ALL_BOUNCES if table.model.interreflection else DIRECT
    for photo, light in lights.items():
        scene, slice_, camera = out / "scenes" / photo, objects[photo], poses[photo].camera
        size = oiio.ImageInput.open(str(inputs["align"] / f"{photo}.exr")).spec()  # of align's maps, by their header
        view = View(size.width, size.height, camera.focal_px, camera.principal_point)
        shapes = [s for own in slice_.objects for s in files.shapes(own, slice_.meshes, poses[photo].objects)]
        exposure = np.array(exposures.get(photo, [1.0] * 3))
        environment = _environment(out, photo, light, lobes[light.illumination], exposure, params)
        write_scene(scene.with_name(f"{photo}.xml"), view, shapes, materials, environment, max_depth)
        exposed = ExposedMap(f"../illumination/{light.illumination}.exr", exposure, environment.camera_from_light)
        write_scene_json(scene.with_name(f"{photo}.json"), view, shapes, materials, exposed, max_depth)
        write_usd_scene(scene.with_name(f"{photo}{SUFFIX}"), view, shapes, materials, exposed)
    progress(4, 4)


def _solved_lights(file: Path, lights: Mapping[str, LightSlice]) -> dict[str, Lobes]:
    """The lobes of every illumination, by name in order; none of one that was not solved for, with a warning."""
    solved = read_lobes(file)
    names = sorted({light.illumination for light in lights.values()})
    for name in names:
        if name not in solved:
            log.warning(
                "illumination '%s' was not solved for, because no pixel in it was observed: it is written as black",
                name,
            )
    return {name: solved.get(name, no_lobes()) for name in names}


def _write_light(out: Path, name: str, light: Lobes, coverage: Path, params: Params) -> None:
    """The map of a light, for Mitsuba too, and the standard errors over its mean radiance, in the same layout, if there are any."""
    lat_long = lat_long_of_lobes(light, params.height, 2 * params.height)
    write_rgb_exr(out / "illumination" / f"{name}.exr", lat_long, LAT_LONG)
    write_hdr(out / "illumination" / f"{name}.hdr", lat_long)
    write_rgb_exr(out / "scenes" / "light" / f"{name}.exr", _mitsuba_map(light, params), LAT_LONG)
    if coverage.exists():
        directions = lat_long_directions(params.height, 2 * params.height)
        write_rgb_exr(out / "coverage" / f"{name}.exr", sampled(read_rgb_exr(coverage), directions), LAT_LONG)


def _mitsuba_map(light: Lobes, params: Params) -> np.ndarray:
    return mitsuba_map(light, params.mitsuba_height, 2 * params.mitsuba_height)


def _environment(
    out: Path, photo: str, light: LightSlice, lobes: Lobes, exposure: np.ndarray, params: Params
) -> Environment:
    """A grey exposure is the scale of the illumination's map; a coloured one needs a map of the photo's own."""
    camera_from_light = np.eye(3) if light.world_from_camera is None else np.array(light.world_from_camera).T
    if np.ptp(exposure) == 0:
        return Environment(f"light/{light.illumination}.exr", float(exposure[0]), camera_from_light)
    file = f"light/{photo}.exposed.exr"  # a dot is in no illumination's name
    write_rgb_exr(out / "scenes" / file, _mitsuba_map(lobes.scaled(exposure), params), LAT_LONG)
    return Environment(file, 1.0, camera_from_light)


class MeshFiles:
    """Meshes read once and written once, split by material, per choice of materials for their parts."""

    def __init__(self, inputs: Inputs, scenes: Path, materials: list[str], crease_deg: float):
        self.scenes, self.materials = scenes, materials
        self.read = MeshesOnce(inputs.file, materials, crease_deg)
        self._stems: dict[tuple, str] = {}  # what files are called before the material, relative to the scenes

    def shapes(
        self, obj: schema.ObjectEntry, meshes: dict[str, MeshEntry], poses: dict[str, ObjectEntry]
    ) -> list[Shape]:
        """One per material of the object; a second choice of materials is in files called <mesh>.2."""
        mesh, pose, place = self.read.mesh(obj.mesh, meshes[obj.mesh], obj.materials), poses[obj.name], np.eye(4)
        place[:3, :3], place[:3, 3] = np.array(pose.rotation) * pose.scale, pose.translation
        names = {label: self.materials[label - 1] for label in mesh.labels}
        key = (obj.mesh, *sorted(obj.materials.items()))
        if key not in self._stems:
            number = 1 + sum(other[0] == obj.mesh for other in self._stems)
            self._stems[key] = f"meshes/{obj.mesh}" + (f".{number}" if number > 1 else "")
            for label, name in names.items():
                part, file = submesh(mesh, label), self.scenes / f"{self._stems[key]}.{name}"
                write_ply(f"{file}.ply", part)
                write_usd_mesh(f"{file}{SUFFIX}", part)
        return [Shape(f"{obj.name}.{m}", f"{self._stems[key]}.{m}.ply", m, place, mesh.open) for m in names.values()]
