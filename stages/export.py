"""Export of materials, lights and scenes to the formats of other programs.

Writes, in the gauge that Mitsuba needs:

illumination/<light>.exr, .hdr   Environment maps; a light with suns also gets <light>_sky.exr and <light>_suns.gltf.
coverage/<light>.exr             Standard error of radiance over its mean, in the same layout.
materials.json, lobes.parquet, exposures.json, lights.json
scenes/<photo>.xml               Mitsuba scenes, with meshes and lights; the same scenes for Blender.
scenes/meshes/<mesh>.png         Diffuse reflectance of a painted mesh as an image.
materials.mtlx, <mesh>.glb, meshes/<mesh>.ply
dataset.json, source/            Facts and meshes of the dataset, for new pictures of the result.
"""

import logging
from collections.abc import Mapping
from itertools import count
from pathlib import Path, PurePosixPath
from typing import Annotated

import msgspec
import numpy as np

from factorlib.conventions import YUP_FROM_CAMERA, lat_long_directions
from factorlib.dataset.schema import LightSlice, ObjectsSlice
from factorlib.errors import InputError
from factorlib.export.exported_scene import (
    ALL_BOUNCES,
    DIRECT,
    ExportedScene,
    ExposedMap,
    extract_suns,
    write_scene_json,
    write_script,
)
from factorlib.export.gltf_writer import variant_name, write_glb, write_suns
from factorlib.export.materialx import materialx
from factorlib.export.mesh_files import MeshFiles
from factorlib.export.mitsuba import headroom_factor, table_in_gauge, write_scene
from factorlib.images.exr import LAT_LONG, read_rgb_exr, write_hdr, write_rgb_exr
from factorlib.inference.surface.aligned_photo import read_aligned_photos
from factorlib.jsonfile import write_json
from factorlib.light.latlong import lat_long_of_lobes, sample_map
from factorlib.light.lobes import Lobes, no_lobes
from factorlib.meshes.ply_stl_off import write_ply
from factorlib.meshes.read_mesh import CREASE_DEG
from factorlib.results.exchange import with_exchange
from factorlib.results.lobe_table import read_lobes, write_lobes
from factorlib.results.materials import MaterialTable, Vec3, read_exposures, read_materials, reflectances
from factorlib.results.poses import read_poses
from factorlib.results.texture_table import read_table
from factorlib.stage import Inputs, Progress
from factorlib.tracing.scene import mitsuba_map
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
    inputs = with_exchange(inputs)
    names = inputs.facts["dataset.materials"]
    slices = msgspec.convert(inputs.facts["dataset.light"], dict[str, LightSlice])
    objects = msgspec.convert(inputs.facts["dataset.objects"], dict[str, ObjectsSlice])
    meshes = dict(sorted({n: m for each in objects.values() for n, m in each.meshes.items()}.items()))
    total = 1 + len({light.illumination for light in slices.values()}) + len(meshes) + len(slices)
    counter = count()
    progress(next(counter), total, "materials")
    for folder in ("illumination", "coverage", "meshes", "scenes/light", "scenes/meshes"):
        (out / folder).mkdir(parents=True)
    files = MeshFiles(inputs, out / "scenes", names, params.crease_deg)
    table, solved, exposures = _solution_in_gauge(inputs["solve"], slices, files, objects)
    files.solved = materials = reflectances(table)
    write_json(out / "materials.json", _with_textures(table, inputs.folders.get("texture")))
    write_json(out / "exposures.json", exposures)
    _write_tables(out, solved)
    _write_dataset(out, inputs)
    for name, lobes in solved.items():
        progress(next(counter), total, f"light of {name}")
        _write_light(out, name, lobes, inputs["solve"] / "coverage" / f"{name}.exr", params)
    photos = read_aligned_photos(inputs, objects)
    for name, mesh in meshes.items():
        progress(next(counter), total, f"mesh {name}")
        overrides = [o.materials for each in objects.values() for o in each.objects if o.mesh == name and o.materials]
        variants = {variant_name(each): files.read.mesh(name, mesh, each) for each in overrides}
        whole = files.read.mesh(name, mesh)
        atlas = files.atlas(name, objects, photos)
        write_glb(out / f"{name}.glb", whole, names, materials, dict(sorted(variants.items())), atlas)
        write_ply(out / "meshes" / f"{name}.ply", whole)
    write_script(out / "scenes")
    poses = read_poses(inputs["align"] / "poses.json")
    depth = ALL_BOUNCES if table.model.interreflection else DIRECT
    for photo, slice_ in slices.items():
        progress(next(counter), total, f"scene of {photo}")
        height, width = photos[photo].geometry["label"].shape
        camera = poses[photo].camera.camera(width, height)
        placed = objects[photo]
        shapes = [s for obj in placed.objects for s in files.shapes(obj, placed.meshes, poses[photo].objects)]
        turn = np.eye(3) if slice_.world_from_camera is None else np.array(slice_.world_from_camera).T
        exposure = np.array(exposures.get(photo, (1.0,) * 3))
        light = ExposedMap(f"../illumination/{slice_.illumination}.exr", exposure, turn)
        scene = ExportedScene(camera, shapes, materials, light, depth)
        _write_scenes(out / "scenes", photo, scene, solved[slice_.illumination], params)
    images = {f"scenes/{file}": painted for file, painted in files.images.items()}
    write_text(out / "materials.mtlx", materialx(materials, images))
    progress(total, total)


def _solution_in_gauge(
    folder: Path, slices: Mapping[str, LightSlice], files: MeshFiles, objects: Mapping[str, ObjectsSlice]
) -> tuple[MaterialTable, dict[str, Lobes], dict[str, Vec3]]:
    """Read materials, lights and exposures in the gauge of Mitsuba, max k_d + max k_s < 1.

    One factor multiplies all reflectances and divides all lights.  A light that was not solved for is black.
    """
    table = read_materials(folder / "materials.json")
    paint = files.paint_ranges(objects, reflectances(table))
    factor = headroom_factor(table.materials, paint)
    solved = read_lobes(folder / "lobes.parquet")
    lights = {}
    for name in sorted({light.illumination for light in slices.values()}):
        if name not in solved:
            log.warning(
                "illumination '%s' is exported as black: no pixel in it was observed, so it was not solved", name
            )
        lights[name] = solved.get(name, no_lobes()).scale(1 / factor)
    return table_in_gauge(table, factor, paint), lights, read_exposures(folder / "exposures.json")


def _with_textures(table: MaterialTable, texture: Path | None) -> MaterialTable:
    """Return the table with the meshes on which each material has a texture."""
    meshes: dict[str, list[str]] = {}
    for evidence in read_table(texture).textures:
        if evidence.kept:
            meshes.setdefault(evidence.material, []).append(evidence.mesh)
    solved = {
        name: msgspec.structs.replace(material, textures=meshes.get(name, msgspec.UNSET))
        for name, material in table.materials.items()
    }
    return msgspec.structs.replace(table, materials=solved)


def _write_tables(out: Path, lights: Mapping[str, Lobes]) -> None:
    """Write the tables of lobes and suns."""
    write_lobes(out / "lobes.parquet", lights)
    suns = {name: [sun.to_dict() for sun in extract_suns(light, YUP_FROM_CAMERA)] for name, light in lights.items()}
    if clash := [name for name in suns if name.endswith(SKY) and suns.get(name.removesuffix(SKY))]:
        raise InputError(
            f"the files of illumination '{clash[0]}' would replace the sky of '{clash[0].removesuffix(SKY)}'",
            key="illumination",
            cure=f"rename it, so that it does not end in {SKY}",
        )
    write_json(out / "lights.json", suns)


def _write_scenes(folder: Path, photo: str, scene: ExportedScene, lobes: Lobes, params: Params) -> None:
    """Write a photo's scene for Blender and Mitsuba, with the suns beside the map.

    Args:
        folder: Folder of the scenes.
        photo: Name of the photo.
        scene: Scene with the whole light as a map.
        lobes: The light, without the photo's exposure.
        params: Parameters of the stage.
    """
    light = scene.light
    exposure = light.exposure
    suns = extract_suns(lobes.scale(exposure), YUP_FROM_CAMERA @ light.camera_from_light)
    name = PurePosixPath(light.file).stem
    sky = f"../illumination/{name}{SKY}.exr" if suns else light.file
    scene = msgspec.structs.replace(scene, light=msgspec.structs.replace(light, file=sky), suns=suns)
    write_scene_json(folder / f"{photo}.json", scene)
    if np.ptp(exposure) == 0:
        light = msgspec.structs.replace(light, file=f"light/{name}.exr")
    else:  # Mitsuba scales all channels alike, so the photo gets its own map; no illumination has a dot in its name
        light = ExposedMap(f"light/{photo}.exposed.exr", np.ones(3), light.camera_from_light)
        _write_mitsuba_map(folder / light.file, lobes.take(~lobes.suns).scale(exposure), params)
    write_scene(folder / f"{photo}.xml", msgspec.structs.replace(scene, light=light))


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
        write_suns(out / "illumination" / f"{name}_suns.gltf", extract_suns(light, YUP_FROM_CAMERA))
    _write_mitsuba_map(out / "scenes" / "light" / f"{name}.exr", sky, params)
    if coverage.exists():
        directions = lat_long_directions(params.height, 2 * params.height)
        write_rgb_exr(out / "coverage" / f"{name}.exr", sample_map(read_rgb_exr(coverage), directions), LAT_LONG)


def _write_mitsuba_map(path: Path, light: Lobes, params: Params) -> None:
    """Write a light as a map in the row layout of Mitsuba's `envmap`."""
    write_rgb_exr(path, mitsuba_map(light, params.mitsuba_height, 2 * params.mitsuba_height), LAT_LONG)
