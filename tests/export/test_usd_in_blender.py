"""USD scenes read by Blender's own importer: camera, places, materials, and a ball lit from the right side."""

import json

import numpy as np
import pytest

from factorlib.conventions import YUP_FROM_CAMERA
from factorlib.export import viewers
from factorlib.export.blender import ExposedMap
from factorlib.export.mitsuba import Shape
from factorlib.export.usd import write_usd_mesh, write_usd_scene
from factorlib.images.exr import LAT_LONG, write_rgb_exr
from factorlib.meshes.read import read_mesh
from factorlib.stage import silent
from stages import export
from tests.export import in_blender, made_export
from tests.export.test_blender import DISTANCE, EXPOSURE, LAMBERTIAN, ROWS, SIDES, VIEW, closed_form, texel_of

BLENDER_FROM_YUP = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])  # Blender turns scenes z-up
OPEN = """
import bpy, json
def opened(file):
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.context.scene.world = bpy.data.worlds.new("world")
    bpy.ops.wm.usd_import(filepath=file)
    bpy.context.scene.camera, = (found for found in bpy.data.objects if found.type == "CAMERA")
    return bpy.context.scene
"""
DUMP = """
told = {}
for file in FILES:
    camera = opened(file).camera
    lens = camera.data
    meshes = [found for found in bpy.data.objects if found.type == "MESH"]
    told[file] = {
        "lens": [lens.lens, lens.sensor_width, lens.shift_x, lens.shift_y],
        "camera": [list(row) for row in camera.matrix_world],
        "vertices": {m.name: [list(m.matrix_world @ v.co) for v in m.data.vertices] for m in meshes},
        "bound": {m.name: [slot.material.name for slot in m.material_slots] for m in meshes},
        "materials": len(bpy.data.materials),
    }
open(OUT, "w").write(json.dumps(told))
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
LIT = [name for name, (material, *_) in SIDES.items() if material is LAMBERTIAN]


def run(body, files, **names):
    told = {"FILES": [str(file) for file in files], **names}
    in_blender.run(OPEN + "".join(f"{name} = {value!r}\n" for name, value in told.items()) + body)


@pytest.mark.long
def test_camera_vertices_and_materials_arrive(tmp_path):
    inputs = made_export.make(tmp_path)
    (tmp_path / "export").mkdir()
    export.main(export.Params(height=8, mitsuba_height=8), inputs, tmp_path / "export", silent)
    files = {photo: tmp_path / "export" / "scenes" / f"{photo}.usda" for photo in made_export.MESHES}
    run(DUMP, files.values(), OUT=str(tmp_path / "told.json"))
    told = json.loads((tmp_path / "told.json").read_text())
    for photo, file in files.items():
        found, camera = told[str(file)], made_export.CAMERAS[photo]
        lens, sensor, *shift = found["lens"]
        assert lens / sensor * camera.width == pytest.approx(camera.focal, rel=1e-6) and sensor == pytest.approx(36)
        middle = (np.array([camera.width, camera.height]) / 2 - camera.centre) * [1, -1] / camera.width
        np.testing.assert_allclose(shift, middle, atol=1e-6)
        expected = np.eye(4)
        expected[:3, :3] = BLENDER_FROM_YUP
        np.testing.assert_allclose(found["camera"], expected, atol=1e-6)
        parts = {"front": ["red"], "side": ["brass", "red"]}[photo]
        assert found["bound"] == {name: [name] for name in parts} and found["materials"] == len(parts)
        entry = inputs.facts["dataset.objects"][photo]["meshes"][made_export.MESHES[photo]]
        mesh = read_mesh(inputs.files[entry["file"]], made_export.NAMES, entry["parts"])
        placed = made_export.POSES[photo].apply(mesh.vertices) @ YUP_FROM_CAMERA @ BLENDER_FROM_YUP.T
        for name, vertices in found["vertices"].items():
            used = np.unique(mesh.faces[mesh.face_label == made_export.NAMES.index(name) + 1])
            np.testing.assert_allclose(vertices, placed[used], atol=2e-6)


@pytest.fixture(scope="module")
def balls(tmp_path_factory):
    """A Lambertian ball under one bright texel, whose exposure has a colour, rendered from each side."""
    folder = tmp_path_factory.mktemp("balls")
    made_export.write_obj(folder / "ball.obj", (1, 1, 1), rows=96)
    write_usd_mesh(folder / "ball.usda", read_mesh(folder / "ball.obj", ["red"], "red"))
    place = np.eye(4)
    place[2, 3] = DISTANCE
    for name in LIT:
        _, direction, camera_from_light = SIDES[name]
        light = np.zeros((ROWS, 2 * ROWS, 3))
        light[texel_of(direction, camera_from_light)] = 1000.0
        write_rgb_exr(folder / f"{name}.light.exr", light, LAT_LONG)
        exposed = ExposedMap(f"./{name}.light.exr", EXPOSURE, camera_from_light)
        write_usd_scene(
            folder / f"{name}.usda",
            VIEW,
            [Shape("ball.red", "ball.ply", "red", place, False)],
            {"red": LAMBERTIAN},
            exposed,
        )
    run(RENDER, [folder / f"{name}.usda" for name in LIT], SIZE=(VIEW.width, VIEW.height))
    return {name: in_blender.rgba(folder / f"{name}.usda.exr") for name in LIT}


@pytest.mark.long
@pytest.mark.parametrize("name", LIT)
def test_dome_lights_the_ball_from_its_side(balls, name):
    expected, ni = closed_form(name, viewers.solved)
    lit = (ni > 0.3) & (balls[name][..., 3] == 1)
    error = balls[name][lit][:, :3] / expected[lit] - 1
    print(
        f"{name}: difference {np.median(np.abs(error)):.2%} (median), {np.percentile(np.abs(error), 90):.2%} (90th percentile)"
    )
    assert lit.sum() >= 15
    assert np.median(np.abs(error)) < 0.01 and np.percentile(np.abs(error), 90) < 0.05
