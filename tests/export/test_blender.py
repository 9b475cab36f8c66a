"""Exported scenes rendered in Blender: frames, light and materials against closed forms and Mitsuba's picture."""

from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import binary_erosion

from factorlib.conventions import YUP_FROM_CAMERA, lat_long_directions, lat_long_of_direction, lat_long_solid_angles
from factorlib.export import viewers
from factorlib.export.blender import ExposedMap, write_scene_json, write_script
from factorlib.export.mitsuba import DIRECT, Shape, View
from factorlib.export.viewers import Angles, distribution
from factorlib.images.exr import LAT_LONG, read_exr, write_rgb_exr
from factorlib.jsonfile import read_json
from factorlib.meshes.ply import write_ply
from factorlib.meshes.read import read_mesh
from factorlib.results.materials import Reflectance
from factorlib.tracing.variant import mitsuba
from tests.export import in_blender, made_export

# a ball under one bright texel: radiance in closed form --------------------------------------------------------------

VIEW = View(40, 32, 90.0, (24.0, 13.0))
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


def texel_of(direction: tuple[float, float, float], camera_from_light: np.ndarray) -> tuple[int, int]:
    """Row and column of the map's texel that a direction of the camera frame falls in."""
    towards = np.array(direction) / np.linalg.norm(direction)
    row, column = lat_long_of_direction(YUP_FROM_CAMERA @ camera_from_light.T @ towards)
    return int(row * ROWS), int(column * 2 * ROWS)


def write_ball(folder: Path, name: str) -> None:
    material, direction, camera_from_light = SIDES[name]
    light = np.zeros((ROWS, 2 * ROWS, 3))
    light[texel_of(direction, camera_from_light)] = 1000.0
    write_rgb_exr(folder / f"{name}.light.exr", light, LAT_LONG)
    place = np.eye(4)
    place[2, 3] = DISTANCE
    shape = Shape("ball", "ball.ply", "red", place, False)
    exposed = ExposedMap(f"{name}.light.exr", EXPOSURE, camera_from_light)
    write_scene_json(folder / f"{name}.json", VIEW, [shape], {"red": material}, exposed, DIRECT)


def closed_form(name: str, model) -> tuple[np.ndarray, np.ndarray]:
    """Radiance of each pixel's middle, by a model of reflection, and n·i where the ball is met (0 elsewhere)."""
    material, direction, camera_from_light = SIDES[name]
    i, j = texel_of(direction, camera_from_light)
    light = camera_from_light @ YUP_FROM_CAMERA @ lat_long_directions(ROWS, 2 * ROWS)[i, j]
    energy = 1000.0 * EXPOSURE * lat_long_solid_angles(ROWS, 2 * ROWS)[i]
    x, y = np.meshgrid(
        np.arange(VIEW.width) + 0.5 - VIEW.principal_point[0], np.arange(VIEW.height) + 0.5 - VIEW.principal_point[1]
    )
    ray = np.stack([x, y, np.full_like(x, VIEW.focal_px)], axis=-1)
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    along, inside = DISTANCE * ray[..., 2], DISTANCE**2 * (ray[..., 2] ** 2 - 1) + 1
    normal = (along - np.sqrt(inside.clip(0)))[..., None] * ray - [0, 0, DISTANCE]
    half = light - ray
    half /= np.linalg.norm(half, axis=-1, keepdims=True)
    ni, no = (normal @ light).clip(0) * (inside > 0), -(normal * ray).sum(axis=-1).clip(max=-0.01)
    angles = Angles(ni, no, (normal * half).sum(axis=-1).clip(0, 1), -(ray * half).sum(axis=-1))
    parts = model(material, angles)
    return (parts.diffuse + distribution(material.alpha, angles.nh)[..., None] * parts.lobe) * ni[
        ..., None
    ] * energy, ni


@pytest.fixture(scope="module")
def balls(tmp_path_factory):
    folder = tmp_path_factory.mktemp("balls")
    made_export.write_obj(folder / "ball.obj", (1, 1, 1), rows=96)
    write_ply(folder / "ball.ply", read_mesh(folder / "ball.obj", ["red"], "red"))
    write_script(folder)
    for name in SIDES:
        write_ball(folder, name)
    return in_blender.rendered(folder, list(SIDES), 128)


@pytest.mark.long
@pytest.mark.parametrize("name", SIDES)
def test_light_of_one_texel_gives_the_radiance_it_should(balls, name):
    expected, ni = closed_form(name, viewers.blender)
    found, alpha = balls[name][..., :3], balls[name][..., 3]
    lit = (ni > 0.3) & (alpha == 1)
    assert lit.sum() >= 15
    error = np.abs(found[lit] / expected[lit] - 1)
    assert np.median(error) < 0.01 and np.percentile(error, 90) < 0.05
    assert found[binary_erosion(ni == 0, np.ones((5, 5)))].max() < 0.01 * found.max()  # nor is the light itself shown


@pytest.mark.long
def test_what_differs_from_the_solved_model_is_the_shadowing(balls):
    """Light that grazes a rough metal: Cycles shows the height-correlated Smith term, not the separable one."""
    found, alpha = balls["grazing"][..., :3], balls["grazing"][..., 3]
    (separable, ni), (correlated, _) = (closed_form("grazing", model) for model in (viewers.solved, viewers.blender))
    lit = (ni > 0.3) & (alpha == 1)
    assert np.median(found[lit] / separable[lit] - 1) > 0.03
    assert abs(np.median(found[lit] / correlated[lit] - 1)) < 0.01


# photos ----------------------------------------------------------------------------------------------------------------


@pytest.mark.long
def test_round_trip_shows_what_mitsuba_shows(exported):
    inputs, out = exported
    photos = list(made_export.MESHES)
    found = in_blender.rendered(out / "scenes", photos, 256)
    module = mitsuba()
    for photo in photos:
        expected = np.array(module.render(module.load_file(str(out / "scenes" / f"{photo}.xml")), spp=512))
        mask = binary_erosion(read_exr(inputs["align"] / f"{photo}.exr")["label"] > 0, np.ones((3, 3)))
        error = np.abs(found[photo][mask][:, :3] / expected[mask] - 1)
        print(f"{photo}: difference {np.median(error):.2%} (median), {np.percentile(error, 95):.2%} (95th percentile)")
        assert np.median(error) <= 0.03 and np.percentile(error, 95) <= 0.1
        assert found[photo][mask][:, 3].min() == 1.0


def test_json_holds_the_scene_as_it_was_exported(exported):
    _, out = exported
    scene = read_json(out / "scenes" / "side.json")
    camera, pose = made_export.CAMERAS["side"], made_export.POSES["side"]
    assert scene["camera"] == {
        "width": 64,
        "height": 56,
        "focal_px": camera.focal,
        "principal_point": list(camera.centre),
    }
    assert [shape["name"] for shape in scene["shapes"]] == ["chair.red", "chair.brass"]
    np.testing.assert_allclose(
        np.array(scene["shapes"][0]["cam_from_object"])[:3], np.c_[pose.rotation, pose.translation]
    )
    assert scene["light"]["exposure"] == [0.5] * 3 and scene["max_depth"] == 2
    np.testing.assert_allclose(scene["light"]["camera_from_light"], made_export.WORLD_FROM_CAMERA["side"].T)
    assert set(scene["materials"]) == {"red", "brass"} and set(scene["materials"]["red"]) == {
        "diffuse",
        "specular",
        "roughness",
    }
    files = [scene["light"]["file"], *(shape["file"] for shape in scene["shapes"])]
    assert all((out / "scenes" / file).is_file() for file in files)


def test_script_is_python(exported):
    compile((exported[1] / "scenes" / "blender.py").read_text(), "blender.py", "exec")
