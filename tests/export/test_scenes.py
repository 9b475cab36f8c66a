"""Exported scenes for Mitsuba and Blender: the same camera, poses, materials and light."""

import importlib.util
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import msgspec
import numpy as np
import pytest
from scipy.ndimage import binary_erosion

from factorlib.conventions import YUP_FROM_CAMERA
from factorlib.dataset.schema import LightSlice
from factorlib.export.exported_scene import DIRECT, ExportedScene, ExportedShape, ExposedMap
from factorlib.export.mitsuba import write_scene
from factorlib.geometry.camera import Camera
from factorlib.images.exr import LAT_LONG, read_exr, write_rgb_exr
from factorlib.light.lobes import Lobes
from factorlib.meshes.ply_stl_off import write_ply
from factorlib.meshes.read_mesh import read_mesh
from factorlib.reflection.reference import Reference
from factorlib.render.photo_scene import PhotoScene, PlacedMesh, traced_photo
from factorlib.render.resynthesis import Reflector, resynthesise
from factorlib.results.lobe_table import read_photo_light
from factorlib.results.materials import Reflectance, read_materials
from factorlib.tracing.scene import mitsuba_map, node_directions, paint, rigid, sharpen_lobes
from factorlib.tracing.variant import mitsuba
from tests.export import made_export


def rendered(path, **options) -> np.ndarray:
    module = mitsuba()
    return np.array(module.render(module.load_file(str(path), **options)))


def block_means(picture: np.ndarray, pixels: np.ndarray, side: int = 8) -> np.ndarray:
    """Means over the `pixels` in blocks of side × side that hold at least a third of them, [blocks, 3]."""
    height, width = pixels.shape

    def sums(values: np.ndarray) -> np.ndarray:
        return values.reshape(height // side, side, width // side, side, -1).sum(axis=(1, 3))

    count = sums(pixels[..., None].astype(float))
    full = count[..., 0] > side**2 / 3
    return sums(picture * pixels[..., None])[full] / count[full]


def whole_pixels(label: np.ndarray) -> np.ndarray:
    """Pixels that show one material only: those whose neighbours are of the same."""
    return np.any([binary_erosion(label == k, np.ones((3, 3))) for k in np.unique(label[label > 0])], axis=0)


@pytest.mark.parametrize("photo", [pytest.param("front", marks=pytest.mark.long), "side"])
def test_scene_equals_resynthesis(exported, photo):
    inputs, out = exported
    geometry, masks = (read_exr(inputs[stage] / f"{photo}.exr") for stage in ("align", "masks"))
    light = read_photo_light(out, photo, msgspec.convert(inputs.facts["dataset.light"][photo], LightSlice))
    table = read_materials(out / "materials.json").materials
    pixels = whole_pixels(geometry["label"])
    reflector, materials = Reflector(Reference(tolerance=1e-3), light), [table[n] for n in made_export.NAMES]
    expected = resynthesise(reflector, materials, {"label": masks["label"] * pixels}, geometry).sum(0)
    result = rendered(out / "scenes" / f"{photo}.xml", spp=1024)
    error = block_means(result, pixels) / block_means(expected, pixels) - 1
    assert len(error) >= 15
    assert np.abs(error).max() < 0.01
    assert not result[binary_erosion(geometry["label"] == 0, np.ones((3, 3)))].any()  # the light itself is not shown


# one texel, one side ------------------------------------------------------------------------------------------------

# in the camera frame
SQUARE = Camera(32, 32, 70.0, (16.0, 16.0))
PLACE = rigid(np.eye(3), np.array([0.0, 0.0, 5.0]))  # of the ball before the camera


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """With a mesh file of a ball."""
    root = tmp_path_factory.mktemp("ball")
    made_export.write_obj(root / "ball.obj", (1, 1, 1))
    write_ply(root / "ball.red.ply", read_mesh(root / "ball.obj", ["red"], "red"))
    return root


def ball_scene(folder, material: Reflectance, lobes: Lobes, two_sided: bool = False, camera_from_light=np.eye(3)):
    """A ball in front of a square camera, through a scene file."""
    write_rgb_exr(folder / "light.exr", mitsuba_map(lobes, 64, 128), LAT_LONG)
    shape = ExportedShape("ball", "ball.red.ply", "red", PLACE, two_sided)
    light = ExposedMap("light.exr", np.ones(3), camera_from_light)
    write_scene(folder / "scene.xml", ExportedScene(SQUARE, [shape], {"red": material}, light))
    return folder / "scene.xml"


# materials -----------------------------------------------------------------------------------------------------------

CASES = {
    "diffuse": Reflectance((0.9, 0.5, 0.1), (0, 0, 0), 0.5),
    "specular": Reflectance((0, 0, 0), (0.9, 0.5, 0.1), 0.5),
    "black": Reflectance((0, 0, 0), (0, 0, 0), 0.5),
    "all of it": Reflectance((0.5, 0.2, 0.3), (0.1, 0.49999, 0.2), 0.4),
}


@pytest.mark.parametrize("two_sided", [False, True])
@pytest.mark.parametrize("case", CASES)
def test_each_kind_of_material_loads_and_reflects_as_solved(folder, case, two_sided):
    constant = Lobes(np.array([[0.0, 0.0, -1.0]]), np.array([0.1]), np.ones((1, 3)))
    picture = rendered(ball_scene(folder, CASES[case], constant, two_sided), spp=100)[14:18, 14:18].mean((0, 1))
    expected = Reflector(Reference(tolerance=1e-3), constant)(CASES[case], constant.axis, constant.axis)[0]
    np.testing.assert_allclose(picture, expected, rtol=0.02)  # the ball's middle against its very centre
    assert (picture > 0).all() == (case != "black")


SHADE = (0.5, 0.6, 0.7)


def test_detail_of_reflectance_is_a_factor_on_the_diffuse_part_in_scenes_that_are_written_and_that_are_traced(folder):
    """The upper half of a ball at a share of its diffuse reflectance: pictures are halves of those of both materials."""
    material, light = CASES["all of it"], Lobes(np.array([[0.0, 0.0, -1.0]]), np.array([0.1]), np.ones((1, 3)))
    ball = read_mesh(folder / "ball.obj", ["red"], "red")
    detail = np.where(ball.vertices[:, 1:2] > 0, SHADE, 1.0)
    whole = rendered(ball_scene(folder, material, light), spp=256)
    halved = msgspec.structs.replace(material, diffuse=tuple(np.multiply(material.diffuse, SHADE).tolist()))
    half = rendered(ball_scene(folder, halved, light), spp=256)
    path = ball_scene(folder, material, light)
    write_ply(folder / "painted.vertices.ply", ball, paint(material, detail))
    path.write_text(path.read_text().replace("ball.red.ply", "painted.vertices.ply"))
    plain = rendered(path, spp=256)  # colours that no material asks for change nothing
    np.testing.assert_allclose(plain[10:22, 10:22].mean((0, 1)), whole[10:22, 10:22].mean((0, 1)), rtol=0.01)
    shape = ExportedShape("ball", "painted.ply", "red", PLACE, False, "painted.png")
    write_scene(path, ExportedScene(SQUARE, [shape], {"red": material}, ExposedMap("light.exr", np.ones(3), np.eye(3))))
    written = rendered(path, spp=256)
    placed = PlacedMesh(
        "ball", msgspec.structs.replace(ball, detail=detail), ("red",), rigid(YUP_FROM_CAMERA, [0.0, 0.0, -5.0])
    )
    traced = traced_photo(PhotoScene(SQUARE, (placed,), light, {"red": material}, DIRECT), 256)[..., :3]
    upper, lower = slice(20, 24), slice(8, 12)  # the object's y is the camera's, which points down
    for picture in (written, traced):
        np.testing.assert_allclose(picture[upper, 12:20].mean((0, 1)), half[upper, 12:20].mean((0, 1)), rtol=0.02)
        np.testing.assert_allclose(picture[lower, 12:20].mean((0, 1)), whole[lower, 12:20].mean((0, 1)), rtol=0.02)
    assert (whole[upper, 12:20] > 1.05 * half[upper, 12:20]).all()


# the map ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sharpness", [0.1, 30.0, 2000.0, 1e5])
def test_map_for_mitsuba_keeps_energy_and_direction(sharpness):
    axis = np.array([0.48, -0.36, 0.8])
    lobe = Lobes(axis[None], np.array([sharpness]), np.ones((1, 3)))
    theta = np.linspace(0, np.pi, 256)
    half = np.pi / 510
    area = -np.diff(np.cos(np.clip([theta - half, theta + half], 0, np.pi)), axis=0)[0] * np.pi / 256  # of the nodes
    values = mitsuba_map(lobe, 256, 512)[..., 0] * area[:, None]
    assert values.sum() == pytest.approx(lobe.energy[0], rel=2e-3)
    mean = np.einsum("hw,hwk->k", values, node_directions(256, 512))
    np.testing.assert_allclose(mean / np.linalg.norm(mean), YUP_FROM_CAMERA @ axis, atol=2e-3)


def test_sharpening_undoes_what_interpolation_widens():
    lobe, spacing = Lobes(np.array([[0.0, 0.0, 1.0]]), np.array([2000.0]), np.ones((1, 3))), 0.0125
    x, nodes = np.linspace(-0.2, 0.2, 20001), np.arange(-20, 21) * spacing
    interpolated = np.interp(x, nodes, np.exp(-0.5 * sharpen_lobes(lobe, spacing).sharpness[0] * nodes**2))
    assert (x**2 * interpolated).sum() / interpolated.sum() == pytest.approx(1 / 2000.0, rel=1e-3)


PHOTOS = list(made_export.MESHES)


# in Blender, by its script ---------------------------------------------------------------------------------------------


def blender_pictures(scenes: Path, photos: Sequence[str], samples: int) -> dict[str, np.ndarray]:
    """RGBA of the photos, by the script beside them, in a process of its own: Blender's libraries do not get on with others."""
    words = [[photo, "--render", str(scenes / f"{photo}.blender.exr"), "--samples", str(samples)] for photo in photos]
    code = f"import sys; sys.path.insert(0, {str(scenes)!r})\nimport blender\nfor each in {words!r}: blender.main(each)"
    command = [shutil.which("blender"), "--background", "--python-exit-code", "1", "--python-expr", code]
    if importlib.util.find_spec("bpy"):
        command = [sys.executable, "-W", "ignore", "-c", code]
    elif command[0] is None:
        pytest.skip('Blender is not installed: make setup EXTRAS="blender", or put `blender` on the PATH')
    process = subprocess.run(command, capture_output=True, text=True, check=False)
    assert process.returncode == 0, process.stderr[-2000:]
    channels = {photo: read_exr(scenes / f"{photo}.blender.exr") for photo in photos}
    return {photo: np.stack([each[name] for name in "RGBA"], axis=-1) for photo, each in channels.items()}


@pytest.mark.long
def test_round_trip_shows_what_mitsuba_shows(exported):
    agree(exported[0]["align"], exported[1] / "scenes", list(made_export.MESHES))


def agree(align: Path, scenes: Path, photos: Sequence[str]) -> None:
    """Blender's pictures of the scenes are Mitsuba's."""
    result = blender_pictures(scenes, photos, 256)
    for photo in photos:
        expected = rendered(scenes / f"{photo}.xml", spp=512)
        mask = binary_erosion(read_exr(align / f"{photo}.exr")["label"] > 0, np.ones((3, 3)))
        error = np.abs(result[photo][mask][:, :3] / expected[mask] - 1)
        print(f"{photo}: difference {np.median(error):.2%} (median), {np.percentile(error, 95):.2%} (95th percentile)")
        assert np.median(error) <= 0.03 and np.percentile(error, 95) <= 0.1
        assert result[photo][mask][:, 3].min() == 1.0
