"""Export of materials, lights and scenes to the formats of other programs.

Writes, in the gauge that Mitsuba needs:

illumination/<light>.exr, .hdr   Environment maps; a light with suns also gets <light>_sky.exr and <light>_suns.gltf.
coverage/<light>.exr             Standard error of radiance over its mean, in the same layout.
materials.json, lobes.parquet, exposures.json, lights.json
scenes/<photo>.xml               Mitsuba scenes, with meshes and lights; the same scenes for Blender and as OpenUSD.
materials.mtlx, <mesh>.glb, meshes/<mesh>.ply
losses.json                      Properties that each format cannot express.
dataset.json, source/            Facts and meshes of the dataset, for new pictures of the result.
"""

import logging
from collections.abc import Mapping
from itertools import count
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
import OpenImageIO as oiio

from factorlib.conventions import YUP_FROM_CAMERA, lat_long_directions
from factorlib.dataset.schema import LightSlice, ObjectsSlice
from factorlib.errors import InputError
from factorlib.export.blender import write_scene_json, write_script
from factorlib.export.environment import mitsuba_map
from factorlib.export.exported_scene import ALL_BOUNCES, DIRECT, ExportedScene, ExposedMap, Sun, suns_of
from factorlib.export.gltf_writer import variant_name, write_glb, write_suns
from factorlib.export.materialx import materialx
from factorlib.export.mesh_files import MeshFiles
from factorlib.export.mitsuba import write_scene
from factorlib.export.other_renderers import differences
from factorlib.export.reflectance_limit import headroom_factor, table_in_gauge
from factorlib.export.usd import SUFFIX, write_usd_scene
from factorlib.images.exr import LAT_LONG, read_rgb_exr, write_hdr, write_rgb_exr
from factorlib.jsonfile import write_json
from factorlib.light.latlong import lat_long_of_lobes, sampled
from factorlib.light.lobes import Lobes, no_lobes
from factorlib.meshes.ply import write_ply
from factorlib.meshes.read import CREASE_DEG
from factorlib.results.lobe_table import read_lobes, write_lobes
from factorlib.results.materials import read_exposures, read_materials, reflectances
from factorlib.results.poses import read_poses
from factorlib.stage import Inputs, Progress
from factorlib.wholefile import write_bytes, write_text

log = logging.getLogger("factorlib.export")
SKY = "_sky"  # suffix of the map without suns
Rows = Annotated[int, msgspec.Meta(ge=8, le=4096)]


class Params(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Sizes of exported maps, and parameters of mesh reading."""

    height: Rows = 128
    """Rows of the exported environment maps; the number of columns is twice as large."""
    mitsuba_height: Rows = 256
    """Rows of the environment maps in the Mitsuba scenes."""
    crease_deg: Annotated[float, msgspec.Meta(gt=0, le=180)] = CREASE_DEG
    """Crease angle, in degrees: an edge whose two triangles differ by more in their normals stays sharp."""


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Write materials, lights, coverage and scenes in the formats of other programs."""
    names = inputs.facts["dataset.materials"]
    solved = inputs["solve"]
    lights = msgspec.convert(inputs.facts["dataset.light"], dict[str, LightSlice])
    objects = msgspec.convert(inputs.facts["dataset.objects"], dict[str, ObjectsSlice])
    meshes = dict(sorted({n: m for each in objects.values() for n, m in each.meshes.items()}.items()))
    total = 1 + len({light.illumination for light in lights.values()}) + len(meshes) + len(lights)
    done = count()
    progress(next(done), total, "materials")
    table = read_materials(solved / "materials.json")
    exposures = read_exposures(solved / "exposures.json")
    # gauge of Mitsuba, max k_d + max k_s < 1: one factor multiplies all reflectances and divides all lights
    factor = headroom_factor(table.materials)
    table = table_in_gauge(table, factor)
    materials = reflectances(table)
    lobes = {n: light.scaled(1 / factor) for n, light in _solved_lights(solved / "lobes.parquet", lights).items()}
    write_json(out / "materials.json", table)
    write_json(out / "exposures.json", exposures)
    write_lobes(out / "lobes.parquet", lobes)
    write_text(out / "materials.mtlx", materialx(materials))
    write_json(out / "losses.json", {name: differences(material) for name, material in materials.items()})
    _write_dataset(out, inputs)
    for folder in ("illumination", "coverage", "meshes", "scenes/light", "scenes/meshes"):
        (out / folder).mkdir(parents=True)
    suns = {name: [_sun(one) for one in suns_of(light, YUP_FROM_CAMERA)] for name, light in lobes.items()}
    if clash := [name for name in lobes if name.endswith(SKY) and suns.get(name.removesuffix(SKY))]:
        raise InputError(
            f"'{clash[0]}' is the name of another illumination's sky", key="illumination", cure="call it otherwise"
        )
    write_json(out / "lights.json", suns)
    for name, light in lobes.items():
        progress(next(done), total, f"light of {name}")
        _write_light(out, name, light, solved / "coverage" / f"{name}.exr", params)
    files = MeshFiles(inputs, out / "scenes", names, params.crease_deg, materials)
    for name, mesh in meshes.items():
        progress(next(done), total, f"mesh {name}")
        whole = files.read.mesh(name, mesh)
        worn = [
            obj.materials for each in objects.values() for obj in each.objects if obj.mesh == name and obj.materials
        ]
        labels = {variant_name(each): files.read.mesh(name, mesh, each).face_label for each in worn}
        write_glb(out / f"{name}.glb", whole, names, materials, dict(sorted(labels.items())))
        write_ply(out / "meshes" / f"{name}.ply", whole)
    write_script(out / "scenes")
    poses = read_poses(inputs["align"] / "poses.json")
    for photo, entry in lights.items():
        progress(next(done), total, f"scene of {photo}")
        maps = oiio.ImageInput.open(str(inputs["align"] / f"{photo}.exr"))
        assert maps is not None  # `align` wrote it
        size = maps.spec()  # from the header
        camera = poses[photo].camera.camera(size.width, size.height)
        exposure = np.array(exposures.get(photo, [1.0] * 3))
        camera_from_light = np.eye(3) if entry.world_from_camera is None else np.array(entry.world_from_camera).T
        own_lobes = lobes[entry.illumination]
        own_suns = suns_of(own_lobes.scaled(exposure), YUP_FROM_CAMERA @ camera_from_light)
        exposed = ExposedMap(f"../illumination/{entry.illumination}.exr", exposure, camera_from_light)
        sky = (
            msgspec.structs.replace(exposed, file=f"../illumination/{entry.illumination}{SKY}.exr")
            if own_suns
            else exposed
        )
        own_meshes = objects[photo].meshes
        placed = poses[photo].objects
        shapes = [s for own in objects[photo].objects for s in files.shapes(own, own_meshes, placed)]
        scene = ExportedScene(
            camera, shapes, materials, exposed, ALL_BOUNCES if table.model.interreflection else DIRECT
        )
        write_usd_scene(out / "scenes" / f"{photo}{SUFFIX}", scene)
        scene = msgspec.structs.replace(scene, light=sky, suns=own_suns)
        write_scene_json(out / "scenes" / f"{photo}.json", scene)
        if np.ptp(exposure) == 0:
            own = msgspec.structs.replace(exposed, file=f"light/{entry.illumination}.exr")
        else:  # Mitsuba scales all channels alike, so the photo gets its own map; no illumination has a dot in its name
            own = ExposedMap(f"light/{photo}.exposed.exr", np.ones(3), camera_from_light)
            _write_mitsuba_map(out / "scenes" / own.file, own_lobes.take(~own_lobes.suns).scaled(exposure), params)
        write_scene(out / "scenes" / f"{photo}.xml", msgspec.structs.replace(scene, light=own))
    progress(total, total)


def _solved_lights(file: Path, lights: Mapping[str, LightSlice]) -> dict[str, Lobes]:
    """Return the lobes of every illumination, sorted by name; none, with a warning, for one that was not solved for."""
    solved = read_lobes(file)
    names = sorted({light.illumination for light in lights.values()})
    for name in names:
        if name not in solved:
            why = "no pixel in it was observed: it is written as black"
            log.warning("illumination '%s' was not solved for, because %s", name, why)
    return {name: solved.get(name, no_lobes()) for name in names}


def _write_dataset(out: Path, inputs: Inputs) -> None:
    """Write the parts of the dataset that pictures of the result need.

    They are the facts, in dataset.json, and the mesh files, under source/ by their paths in the dataset.
    """
    write_json(out / "dataset.json", {name: inputs.facts[name] for name in sorted(inputs.facts)})
    for relative, file in sorted(inputs.files.items()):
        copy = out / "source" / relative
        copy.parent.mkdir(parents=True, exist_ok=True)
        write_bytes(copy, file.read_bytes())


def _write_light(out: Path, name: str, light: Lobes, coverage: Path, params: Params) -> None:
    """Write the maps of a light: radiance, without suns, for Mitsuba, and coverage if there is one."""
    lat_long = lat_long_of_lobes(light, params.height, 2 * params.height)
    write_rgb_exr(out / "illumination" / f"{name}.exr", lat_long, LAT_LONG)
    write_hdr(out / "illumination" / f"{name}.hdr", lat_long)
    sky = light.take(~light.suns)
    if light.suns.any():
        write_rgb_exr(out / "illumination" / f"{name}{SKY}.exr", lat_long_of_lobes(sky, *lat_long.shape[:2]), LAT_LONG)
        write_suns(out / "illumination" / f"{name}_suns.gltf", suns_of(light, YUP_FROM_CAMERA))
    _write_mitsuba_map(out / "scenes" / "light" / f"{name}.exr", sky, params)
    if coverage.exists():
        directions = lat_long_directions(params.height, 2 * params.height)
        write_rgb_exr(out / "coverage" / f"{name}.exr", sampled(read_rgb_exr(coverage), directions), LAT_LONG)


def _sun(sun: Sun) -> dict[str, Any]:
    """Return the entry of a sun in lights.json."""
    return {
        **{name: getattr(sun, name).tolist() for name in ("direction", "irradiance")},
        "angular_diameter_deg": sun.angular_diameter_deg,
    }


def _write_mitsuba_map(path: Path, light: Lobes, params: Params) -> None:
    """Write a light as a map in the row layout of Mitsuba's `envmap`."""
    write_rgb_exr(path, mitsuba_map(light, params.mitsuba_height, 2 * params.mitsuba_height), LAT_LONG)
