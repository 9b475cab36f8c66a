"""The generated sets: the same seed is the same bytes, and what is written is what the format asks for."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from factorlib.conventions import YUP_FROM_CAMERA, lat_long_directions, lat_long_solid_angles
from factorlib.dataset.read_dataset import read_dataset
from factorlib.generate import eames, folder, surroundings, synthetic
from factorlib.generate.chair import chair, label_parts
from factorlib.generate.paint import choose_patterns, paint_mesh
from factorlib.geometry.camera import Camera, Pose, rotation_of_vector
from factorlib.geometry.raster import rasterise
from factorlib.images.exr import read_exr, read_rgb_exr, write_rgb_exr
from factorlib.images.photo import read_photo
from factorlib.images.picture import read_png
from factorlib.light.latlong import sample_map
from factorlib.meshes.mesh import Mesh, area_vectors
from factorlib.meshes.read_mesh import read_mesh
from tests.refusal import refusal
from tests.runner.toy import files_of

pytest.importorskip("mitsuba")


def made(out: Path, seed: int) -> Path:
    """A small synthetic set."""
    parameters = synthetic.SyntheticOptions(width=96, height=64, focal_px=125.0, light_rows=16, spp=64, light_spp=2)
    synthetic.generate(out, seed, [], parameters, lambda done, total, text: None)
    return out


def made_chairs(out: Path, names=("kitchen",), spp: int = 8, **easier: bool) -> Path:
    """A small chair set of seed 3."""
    parameters = eames.ChairSetOptions(width=96, height=72, light_rows=16, spp=spp, light_spp=2, **easier)
    shots = [shot for shot in eames.SET.shots if shot.name in names]
    eames.generate(out, 3, [], parameters, lambda done, total, text: None, shots)
    return out


@pytest.fixture(scope="module")
def small(tmp_path_factory) -> Path:
    return made(tmp_path_factory.mktemp("sets") / "small", seed=0)


@pytest.fixture(scope="module")
def exact(tmp_path_factory) -> Path:
    return made_chairs(tmp_path_factory.mktemp("sets") / "exact", exact=True)


def test_the_same_seed_is_the_same_bytes(exact, tmp_path):
    assert files_of(made_chairs(tmp_path / "again", exact=True)) == files_of(exact)


@pytest.mark.long
def test_the_same_seed_is_the_same_bytes_of_bodies(small, tmp_path):
    assert files_of(made(tmp_path / "again", seed=0)) == files_of(small)


def test_a_matte_pixel_is_its_irradiance(small):
    """Photo, mask, normals, light and exposure belong together: Lambert's law from the truth gives the red ball."""
    radiance, labels = read_photo(small / "photos/garden.exr").radiance, read_png(small / "masks/garden.png")[..., 0]
    maps, light = read_exr(small / "truth/garden_normal.exr"), read_rgb_exr(small / "truth/garden_light.exr")
    normal = np.stack([maps[f"normal.{axis}"] for axis in "xyz"], axis=-1)[labels == 1] @ YUP_FROM_CAMERA
    irradiance = irradiance_of(normal, light)
    diffuse = np.array(read_dataset(small).truth.materials["red"].diffuse) / np.pi * irradiance
    beyond = (radiance[labels == 1] / diffuse - 1)[
        :, 0
    ]  # in red, where the specular part is small: it adds, and little
    assert 0 < np.median(beyond) < 0.2
    assert np.quantile(beyond, 0.05) > -0.1 and np.quantile(beyond, 0.95) < 0.5  # with the noise of few samples


def irradiance_of(normal, light):
    """∫ L max(n·i, 0) di over the texels of a map in the normals' frame, [n, 3]."""
    height, width = 64, 128
    light = sample_map(light, lat_long_directions(height, width))
    cosine = np.maximum(np.einsum("nd,hwd->nhw", normal, lat_long_directions(height, width)), 0)
    return np.einsum("nhw,hwc,h->nc", cosine, light, lat_long_solid_angles(height, width))


def test_a_users_lights_replace_the_made_ones(tmp_path):
    light = np.ones((32, 64, 3)) * [1.0, 2.0, 3.0]
    light[3, 7] = 100
    write_rgb_exr(tmp_path / "sky.exr", light)
    taken = surroundings.read_captured_light(tmp_path / "sky.exr", 16)
    assert taken.shape == (16, 32, 3)
    assert np.unravel_index(taken[..., 0].argmax(), (16, 32)) == (1, 3)
    assert taken.mean() == pytest.approx(1)
    write_rgb_exr(tmp_path / "square.exr", np.ones((8, 8, 3)))
    refusal("twice as wide as high", surroundings.read_captured_light, tmp_path / "square.exr", 8)


def test_exact_geometry_is_the_photographed_mesh_at_its_pose(exact):
    dataset = read_dataset(exact)
    (photo,) = dataset.spec.photos
    (thing,) = photo.objects
    assert np.allclose(thing.pose.rotation, dataset.truth.poses["kitchen"][thing.name].rotation, atol=1e-6)
    assert np.allclose(thing.pose.translation, dataset.truth.poses["kitchen"][thing.name].translation, atol=1e-6)
    assert photo.camera.focal_px == pytest.approx(folder.focal_px_of_35mm(45, 96, 72), abs=0.01)
    mesh = read_mesh(exact / "meshes/chair.obj", ["red", "wood"], {"shell": "red", "legs": "wood"})
    traced = label_parts(chair(), {"shell": 1, "legs": 2})
    assert len(mesh.faces) == len(traced.faces)
    apart, nearest = cKDTree(traced.vertices).query(mesh.vertices)
    assert apart.max() < 1e-6 and len(set(nearest)) == len(traced.vertices)
    alike = np.linalg.norm(mesh.normals - traced.normals[nearest], axis=1) < 1e-6
    assert alike.mean() > 0.97, (
        "of flat ends of legs, which stand on the floor or in the seat, the reader takes its own"
    )


# ── painted chairs ───────────────────────────────────────────────────────────────────────────────────────────────────


@cache
def painted_chair(colour: str) -> Mesh:
    """The chair of seed 0 with a shell of this colour."""
    names = list(eames.SET.materials)
    parts = label_parts(chair(), {"shell": names.index(colour) + 1, "legs": names.index("wood") + 1})
    return paint_mesh(parts, 0, eames.SET.materials)


@pytest.mark.parametrize("colour", ["red", "yellow", "white"])
def test_the_mean_factor_over_a_material_is_1_within_bounds(colour):
    mesh = painted_chair(colour)
    area = np.linalg.norm(area_vectors(mesh.vertices, mesh.faces), axis=1)
    patterns = choose_patterns(0, eames.SET.materials)
    for label in mesh.labels:
        name, material = list(eames.SET.materials.items())[label - 1]
        detail = mesh.detail[mesh.faces[mesh.face_label == label]]
        mean = np.average(detail.mean(axis=1), axis=0, weights=area[mesh.face_label == label])
        assert mean == pytest.approx(np.ones(3), abs=1e-9) and 0.3 <= detail.min() <= detail.max() <= 2
        assert (detail * material.mixture[1]).max() <= 1 + 1e-9, "the renderer clips nothing"
        assert ((detail.std(axis=(0, 1)) > 0.1) == (name in patterns)).all() and len(patterns) == 3


def test_paint_belongs_to_the_surface():
    """Two cameras that look at the same points from elsewhere find the same albedo there."""
    mesh = painted_chair("yellow")
    camera = Camera(64, 64, 1500.0, (32.0, 32.0))
    views = []
    for turn in (0.0, 0.35):
        rotation = rotation_of_vector(np.array([0, np.pi + turn, 0])) @ np.diag([-1.0, -1.0, 1.0])
        pose = Pose(rotation.T, -rotation.T @ np.array([0, 0.62, -0.1]) + [0, 0, 2.0])
        depth = rasterise(mesh, camera, pose).depth
        points = ((depth[..., None] * camera.rays())[depth > 0] - pose.translation) @ pose.rotation
        albedo = folder.albedo_map([mesh], list(eames.SET.materials.values()), camera, [pose])
        views.append((points, np.log(albedo[depth > 0])))
    apart, nearest = cKDTree(views[1][0]).query(views[0][0])
    log, other = views[0][1][apart < 0.001], views[1][1][nearest[apart < 0.001]]
    assert len(log) > 500 and (log.std(axis=0) > 0.1).all() and np.quantile(np.abs(log - other), 0.95) < 0.02
