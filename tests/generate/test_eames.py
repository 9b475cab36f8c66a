"""The chair set made easier: exact geometry, distant light, direct light, each by itself."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree
from typer.testing import CliRunner

from factorlib.conventions import YUP_FROM_CAMERA
from factorlib.dataset.read import read_dataset
from factorlib.generate import eames, folder
from factorlib.generate.__main__ import app
from factorlib.generate.chair import chair, labelled
from factorlib.images.exr import read_rgb_exr, write_rgb_exr
from factorlib.images.photo import read_photo
from factorlib.images.picture import read_png
from factorlib.light.latlong import sampled
from factorlib.meshes.read import read_mesh

pytest.importorskip("mitsuba")
SHOTS = {shot.name: shot for shot in eames.SET.shots}


def made(out: Path, name: str, lights=(), spp: int = 8, **easier: bool) -> Path:
    """One photo of seed 3."""
    parameters = eames.Parameters(width=96, height=72, light_rows=16, spp=spp, light_spp=2, **easier)
    eames.generate(out, 3, lights, parameters, lambda done, total, text: None, [SHOTS[name]])
    return out


@pytest.fixture(scope="module")
def plain(tmp_path_factory) -> Path:
    return made(tmp_path_factory.mktemp("plain") / "set", "kitchen")


@pytest.fixture(scope="module")
def exact(tmp_path_factory) -> Path:
    return made(tmp_path_factory.mktemp("exact") / "set", "kitchen", exact=True)


def files(out: Path) -> dict[str, bytes]:
    return {str(path.relative_to(out)): path.read_bytes() for path in out.rglob("*") if path.is_file()}


def radiance_and_light(out: Path, name: str):
    """The photo, and the true light as a map in the camera's frame turned y-up; in the photo's unit."""
    return read_photo(out / f"photos/{name}.jpg"), read_rgb_exr(out / f"truth/{name}_light.exr")


def test_exact_geometry_changes_no_photo(plain, exact):
    before, after = files(plain), files(exact)
    assert before.keys() == after.keys()
    assert {name for name in before if before[name] != after[name]} == {"dataset.yaml", "meshes/chair.obj"}


def test_exact_geometry_is_the_photographed_mesh_at_its_pose(exact):
    dataset = read_dataset(exact)
    (photo,) = dataset.spec.photos
    (thing,) = photo.objects
    assert np.allclose(thing.pose.rotation, dataset.truth.poses["kitchen"][thing.name].rotation, atol=1e-6)
    assert np.allclose(thing.pose.translation, dataset.truth.poses["kitchen"][thing.name].translation, atol=1e-6)
    assert photo.camera.focal_px == pytest.approx(folder.focal_px_of_35mm(45, 96, 72), abs=0.01)
    mesh = read_mesh(exact / "meshes/chair.obj", ["red", "wood"], {"shell": "red", "legs": "wood"})
    traced = labelled(chair(), {"shell": 1, "legs": 2})
    assert len(mesh.faces) == len(traced.faces)
    apart, nearest = cKDTree(traced.vertices).query(mesh.vertices)
    assert apart.max() < 1e-6 and len(set(nearest)) == len(traced.vertices)
    alike = np.linalg.norm(mesh.normals - traced.normals[nearest], axis=1) < 1e-6
    assert (
        alike.mean() > 0.97
    )  # of flat ends of legs, which stand on the floor or in the seat, the reader takes its own


def test_behind_the_chairs_a_distant_light_is_its_map(tmp_path):
    """Light, camera and exposure belong together: each pixel beside the chairs is the map in the pixel's direction."""
    photo, light = radiance_and_light(made(tmp_path / "set", "kitchen", distant=True, direct=True), "kitchen")
    focal = folder.focal_px_of_35mm(45, 96, 72)
    column, row = np.meshgrid(np.arange(96) + 0.5 - 48, np.arange(72) + 0.5 - 36)
    ray = np.stack([column, row, np.full(row.shape, focal)], axis=-1)
    expected = sampled(light, ray / np.linalg.norm(ray, axis=-1, keepdims=True) @ YUP_FROM_CAMERA)
    beside = (read_png(tmp_path / "set/masks/kitchen.png")[..., 0] == 0) & ~photo.clipped.any(axis=-1)
    off = photo.radiance[beside] - expected[beside]
    assert beside.mean() > 0.3 and np.abs(off).mean() < 0.03 * expected[beside].mean()


def test_without_bounces_chairs_are_darker(tmp_path):
    """In one light, against that light's unit, in which exposure is gone."""
    brightness = []
    for direct in (True, False):
        out = made(tmp_path / str(direct), "kitchen", spp=32, distant=True, direct=direct)
        photo, light = radiance_and_light(out, "kitchen")
        on_chair = np.isin(read_png(out / "masks/kitchen.png")[..., 0], [1, 2, 3, 4, 5])
        brightness.append(np.minimum(photo.radiance[on_chair], 0.9).mean() / light.mean())
    assert brightness[0] < 0.97 * brightness[1]


def test_the_light_of_a_direct_set_is_what_shines_by_itself(tmp_path, plain):
    _, all_of_it = radiance_and_light(plain, "kitchen")
    _, direct = radiance_and_light(made(tmp_path / "set", "kitchen", direct=True), "kitchen")
    assert (all_of_it > 0).all() and (direct == 0).all(axis=-1).mean() > 0.8 and direct.max() > 1


def test_a_users_distant_light_has_no_ground(tmp_path):
    write_rgb_exr(tmp_path / "constant.exr", np.ones((16, 32, 3)))
    maps = [tmp_path / "constant.exr"]
    _, light = radiance_and_light(made(tmp_path / "distant", "kitchen", maps, distant=True), "kitchen")
    np.testing.assert_allclose(light, light[0, 0, 0], rtol=1e-3)
    _, light = radiance_and_light(made(tmp_path / "near", "kitchen", maps), "kitchen")
    assert light.min() < 0.5 * light.max()


def test_an_easier_set_does_not_replace_the_one_the_project_carries(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    done = CliRunner().invoke(app, ["eames", "--direct"])
    assert done.exit_code == 2 and "--out" in done.output and not list(tmp_path.iterdir())
