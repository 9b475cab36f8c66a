"""What was solved, in the forms that other programs read.

Writes illumination/<light>.exr and .hdr, coverage/<light>.exr, materials.json, lobes.parquet and exposures.json in the gauge that
Mitsuba needs, scenes/<photo>.xml with their meshes and lights, the same scenes for Blender and as OpenUSD, materials.mtlx and <mesh>.glb,
and losses.json: what is lost on the way to other programs.
"""

import logging
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
from factorlib.images.exr import LAT_LONG, read_exr, write_rgb_exr
from factorlib.images.write import write_hdr
from factorlib.light.latlong import lat_long_of_lobes, sampled
from factorlib.light.lobes import Lobes, no_lobes
from factorlib.meshes.ply import submesh, write_ply
from factorlib.meshes.read import CREASE_DEG, MeshesOnce
from factorlib.results.exposures import read_exposures, write_exposures
from factorlib.results.lobes import read_lobes, write_lobes
from factorlib.results.materials import MaterialTable, read_materials, reflectances, write_materials
from factorlib.results.poses import CameraEntry, ObjectEntry, read_poses
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
    names: list[str] = inputs.facts["dataset.materials"]
    lights = msgspec.convert(inputs.facts["dataset.light"], dict[str, LightSlice])
    objects = msgspec.convert(inputs.facts["dataset.objects"], dict[str, ObjectsSlice])
    progress(0, 4, "materials")
    table, lobes = _in_gauge(inputs["solve"], {light.illumination for light in lights.values()})
    exposures = read_exposures(inputs["solve"] / "exposures.json")
    write_materials(out / "materials.json", table)
    write_exposures(out / "exposures.json", exposures)
    write_lobes(out / "lobes.parquet", lobes)
    materials = reflectances(table)
    write_materialx(out / "materials.mtlx", materials)
    write_losses(out / "losses.json", materials)
    progress(1, 4, "lights")
    _write_lights(out, lobes, params)
    _write_coverage(out, inputs["solve"], lobes, params)
    progress(2, 4, "meshes")
    files = MeshFiles(inputs, out / "scenes", names, params.crease_deg)
    for name, mesh in sorted({n: m for each in objects.values() for n, m in each.meshes.items()}.items()):
        write_glb(out / f"{name}.glb", files.read.mesh(name, mesh), names, materials)
    progress(3, 4, "scenes")
    write_script(out / "scenes")
    poses, max_depth = (
        read_poses(inputs["align"] / "poses.json"),
        ALL_BOUNCES if table.model.interreflection else DIRECT,
    )
    for photo, light in lights.items():
        view = _view(inputs["align"] / f"{photo}.exr", poses[photo].camera)
        shapes = [
            shape
            for obj in objects[photo].objects
            for shape in files.shapes(obj, objects[photo].meshes, poses[photo].objects)
        ]
        exposure = np.array(exposures.get(photo, [1.0] * 3))
        environment = _environment(out, photo, light, lobes[light.illumination], exposure, params)
        write_scene(out / "scenes" / f"{photo}.xml", view, shapes, materials, environment, max_depth)
        exposed = ExposedMap(f"../illumination/{light.illumination}.exr", exposure, environment.camera_from_light)
        write_scene_json(out / "scenes" / f"{photo}.json", view, shapes, materials, exposed, max_depth)
        write_usd_scene(out / "scenes" / f"{photo}{SUFFIX}", view, shapes, materials, exposed)
    progress(4, 4)


def _in_gauge(solved: Path, illuminations: set[str]) -> tuple[MaterialTable, dict[str, Lobes]]:
    """materials.json and the lobes of every illumination; the factor that leaves the one enters the other."""
    table = read_materials(solved / "materials.json")
    factor = headroom_factor(table.materials)
    found = read_lobes(solved / "lobes.parquet")
    for name in sorted(illuminations - set(found)):
        log.warning(
            "illumination '%s' was not solved for, because no pixel in it was observed: it is written as black", name
        )
    return table_in_gauge(table, factor), {
        name: found.get(name, no_lobes()).scaled(1 / factor) for name in sorted(illuminations)
    }


def _write_lights(out: Path, lobes: dict[str, Lobes], params: Params) -> None:
    for folder in ("illumination", "scenes/light", "scenes/meshes"):
        (out / folder).mkdir(parents=True)
    for name, light in lobes.items():
        lat_long = lat_long_of_lobes(light, params.height, 2 * params.height)
        write_rgb_exr(out / "illumination" / f"{name}.exr", lat_long, LAT_LONG)
        write_hdr(out / "illumination" / f"{name}.hdr", lat_long)
        write_rgb_exr(out / "scenes" / "light" / f"{name}.exr", _mitsuba_map(light, params), LAT_LONG)


def _write_coverage(out: Path, solved: Path, lobes: dict[str, Lobes], params: Params) -> None:
    """Standard errors of the lights over their mean radiance, in the maps' layout; a light that was not solved has none."""
    (out / "coverage").mkdir()
    directions = lat_long_directions(params.height, 2 * params.height)
    for name in lobes:
        if (file := solved / "coverage" / f"{name}.exr").exists():
            channels = read_exr(file)
            write_rgb_exr(
                out / "coverage" / f"{name}.exr",
                sampled(np.stack([channels[c] for c in "RGB"], -1), directions),
                LAT_LONG,
            )


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


def _view(aligned: Path, camera: CameraEntry) -> View:
    """The photo's camera; its size from the header of align's maps."""
    spec = oiio.ImageInput.open(str(aligned)).spec()
    return View(spec.width, spec.height, camera.focal_px, camera.principal_point)


class MeshFiles:
    """Meshes read once and written once, split by material, per choice of materials for their parts."""

    def __init__(self, inputs: Inputs, scenes: Path, materials: list[str], crease_deg: float):
        self.scenes, self.materials = scenes, materials
        self.read = MeshesOnce(inputs.file, materials, crease_deg)
        self._stems: dict[tuple, str] = {}

    def shapes(
        self, obj: schema.ObjectEntry, meshes: dict[str, MeshEntry], poses: dict[str, ObjectEntry]
    ) -> list[Shape]:
        """One per material of the object."""
        mesh, stem = self.read.mesh(obj.mesh, meshes[obj.mesh], obj.materials), self._written(obj, meshes)
        place = np.eye(4)
        pose = poses[obj.name]
        place[:3, :3], place[:3, 3] = np.array(pose.rotation) * pose.scale, pose.translation
        used = [self.materials[label - 1] for label in mesh.labels]
        return [Shape(f"{obj.name}.{m}", f"{stem}.{m}.ply", m, place, mesh.open) for m in used]

    def _written(self, obj: schema.ObjectEntry, meshes: dict[str, MeshEntry]) -> str:
        """What the files are called before the material, relative to the scenes; a second choice of materials is <mesh>.2."""
        key = (obj.mesh, *sorted(obj.materials.items()))
        if key not in self._stems:
            number = 1 + sum(other[0] == obj.mesh for other in self._stems)
            stem = f"meshes/{obj.mesh}" + (f".{number}" if number > 1 else "")
            mesh = self.read.mesh(obj.mesh, meshes[obj.mesh], obj.materials)
            for label in mesh.labels:
                part, file = submesh(mesh, label), self.scenes / f"{stem}.{self.materials[label - 1]}"
                write_ply(f"{file}.ply", part)
                write_usd_mesh(f"{file}{SUFFIX}", part)
            self._stems[key] = stem
        return self._stems[key]
