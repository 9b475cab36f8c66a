"""Exported scenes in Blender, by its script and as USD: frames, light and materials against closed forms and Mitsuba's picture.

Blender runs in a process of its own: its libraries do not get on with others of the same names.
"""

import importlib.util
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import binary_erosion

from factorlib.conventions import YUP_FROM_CAMERA, lat_long_of_direction
from factorlib.export.blender import write_scene_json, write_script
from factorlib.export.scene import ExposedMap, Scene, Shape
from factorlib.export.usd import write_usd_mesh, write_usd_scene
from factorlib.export.viewers import MODELS, solved
from factorlib.geometry.camera import Camera
from factorlib.images.exr import LAT_LONG, read_exr, write_rgb_exr
from factorlib.meshes.ply import write_ply
from factorlib.meshes.read import read_mesh
from factorlib.results.materials import Reflectance
from factorlib.tracing.variant import mitsuba
from tests.export import made_export

MISSING = 'Blender is not installed: make setup EXTRAS="blender", or put `blender` on the PATH'
OPEN = """
import bpy, json
def opened(file):
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.context.scene.world = bpy.data.worlds.new("world")
    bpy.ops.wm.usd_import(filepath=file)
    bpy.context.scene.camera, = (found for found in bpy.data.objects if found.type == "CAMERA")
    return bpy.context.scene
"""
RENDER = """
for file in FILES:
    scene = opened(file)
    scene.render.engine, scene.render.film_transparent = "CYCLES", True
    scene.render.resolution_x, scene.render.resolution_y = SIZE
    scene.cycles.samples, scene.cycles.pixel_filter_type, scene.cycles.max_bounces = 128, "BOX", 0
    scene.cycles.use_adaptive_sampling = scene.cycles.use_denoising = False
    scene.cycles.sample_clamp_direct = scene.cycles.light_sampling_threshold = 0
    scene.render.image_settings.file_format, scene.render.image_settings.color_depth = "OPEN_EXR", "32"
    scene.render.image_settings.color_mode = "RGBA"
    scene.view_settings.view_transform = "Standard"
    scene.render.filepath = file + ".exr"
    bpy.ops.render.render(write_still=True)
"""


def rendered(scenes: Path, photos: Sequence[str], samples: int, *words: str) -> dict[str, np.ndarray]:
    """RGBA of the photos, by the script beside them, all in one process; skips the test where there is no Blender."""
    jobs = [
        [photo, "--render", str(scenes / f"{photo}.blender.exr"), "--samples", str(samples), *words] for photo in photos
    ]
    code = (
        f"import sys; sys.path.insert(0, {str(scenes)!r})\nimport blender\nfor words in {jobs!r}: blender.main(words)"
    )
    run(code)
    return {photo: rgba(scenes / f"{photo}.blender.exr") for photo in photos}


def run(code: str) -> None:
    """Python in Blender; skips the test where there is none."""
    done = subprocess.run(_command(code), capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]


def _command(code: str) -> list[str]:
    if importlib.util.find_spec("bpy"):
        return [sys.executable, "-W", "ignore", "-c", code]
    if program := shutil.which("blender"):
        return [program, "--background", "--python-exit-code", "1", "--python-expr", code]
    pytest.skip(MISSING)


def rgba(path: Path) -> np.ndarray:
    """[rows, columns, 4] of an EXR."""
    channels = read_exr(path)
    return np.stack([channels[name] for name in "RGBA"], axis=-1)


def run_usd(body, files, **names):
    told = {"FILES": [str(file) for file in files], **names}
    run(OPEN + "".join(f"{name} = {value!r}\n" for name, value in told.items()) + body)


# a ball under one bright texel: radiance in closed form --------------------------------------------------------------

CAMERA = Camera(40, 32, 90.0, (24.0, 13.0))
DISTANCE, ROWS, EXPOSURE = 5.0, 64, np.array([2.0, 1.0, 0.5])
LAMBERTIAN = Reflectance((0.5, 0.4, 0.3), (0, 0, 0), 0.5)
ROUGH_METAL = Reflectance((0, 0, 0), (0.8, 0.6, 0.4), 0.7)
GLOSSY = Reflectance((0.4, 0.2, 0.1), (0.1, 0.2, 0.3), 0.45)
TURNED = made_export.WORLD_FROM_CAMERA["side"].T
SIDES = {  # material, direction to the light (camera frame), camera_from_light
    "right": (LAMBERTIAN, (1.0, 0.1, -0.5), np.eye(3)),
    "left": (LAMBERTIAN, (-1.0, 0.2, -0.3), np.eye(3)),
    "above": (LAMBERTIAN, (0.1, -1.0, -0.2), np.eye(3)),
    "below": (LAMBERTIAN, (-0.2, 1.0, -0.4), np.eye(3)),
    "viewer": (LAMBERTIAN, (0.1, 0.2, -1.0), np.eye(3)),
    "turned": (LAMBERTIAN, (0.7, -0.5, -0.6), TURNED),
    "glossy": (GLOSSY, (-0.5, -0.6, -0.8), np.eye(3)),
    "grazing": (ROUGH_METAL, (0.9, -0.2, 0.6), np.eye(3)),
}
LIT = [name for name, (material, *_) in SIDES.items() if material is LAMBERTIAN]


def texel_of(direction: tuple[float, float, float], camera_from_light: np.ndarray) -> tuple[int, int]:
    """Row and column of the map's texel that a direction of the camera frame falls in."""
    towards = np.array(direction) / np.linalg.norm(direction)
    row, column = lat_long_of_direction(YUP_FROM_CAMERA @ camera_from_light.T @ towards)
    return int(row * ROWS), int(column * 2 * ROWS)


@pytest.fixture(scope="module")
def balls(tmp_path_factory):
    """RGBA of every ball by the script, and of the Lambertian ones as USD."""
    folder = tmp_path_factory.mktemp("balls")
    made_export.write_obj(folder / "ball.obj", (1, 1, 1), rows=96)
    mesh = read_mesh(folder / "ball.obj", ["red"], "red")
    write_ply(folder / "ball.ply", mesh)
    write_usd_mesh(folder / "ball.usda", mesh)
    write_script(folder)
    place = np.eye(4)
    place[2, 3] = DISTANCE
    for name, (material, direction, camera_from_light) in SIDES.items():
        light = np.zeros((ROWS, 2 * ROWS, 3))
        light[texel_of(direction, camera_from_light)] = 1000.0
        write_rgb_exr(folder / f"{name}.light.exr", light, LAT_LONG)
        exposed = ExposedMap(f"./{name}.light.exr", EXPOSURE, camera_from_light)
        scene = Scene(CAMERA, [Shape("ball.red", "ball.ply", "red", place, False)], {"red": material}, exposed)
        write_scene_json(folder / f"{name}.json", scene)
        write_usd_scene(folder / f"{name}.usda", scene)
    pictures = rendered(folder, list(SIDES), 128)
    run_usd(RENDER, [folder / f"{name}.usda" for name in LIT], SIZE=(CAMERA.width, CAMERA.height))
    return pictures, {name: rgba(folder / f"{name}.usda.exr") for name in LIT}


CASES = [(0, name, MODELS["blender"]) for name in SIDES] + [(1, name, solved) for name in LIT]


# photos --------------------------------------------------------------------------------------------------------------


@pytest.mark.long
def test_round_trip_shows_what_mitsuba_shows(exported):
    inputs, out = exported
    photos, module = list(made_export.MESHES), mitsuba()
    found = rendered(out / "scenes", photos, 256)
    for photo in photos:
        expected = np.array(module.render(module.load_file(str(out / "scenes" / f"{photo}.xml")), spp=512))
        mask = binary_erosion(read_exr(inputs["align"] / f"{photo}.exr")["label"] > 0, np.ones((3, 3)))
        error = np.abs(found[photo][mask][:, :3] / expected[mask] - 1)
        print(f"{photo}: difference {np.median(error):.2%} (median), {np.percentile(error, 95):.2%} (95th percentile)")
        assert np.median(error) <= 0.03 and np.percentile(error, 95) <= 0.1
        assert found[photo][mask][:, 3].min() == 1.0
