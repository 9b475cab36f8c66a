"""The generated sets: the same seed is the same bytes, and what is written is what the format asks for."""

import hashlib
from pathlib import Path

import numpy as np
import pytest

from factorlib.conventions import YUP_FROM_CAMERA, lat_long_directions, lat_long_solid_angles
from factorlib.dataset.read import read_dataset
from factorlib.errors import InputError
from factorlib.generate import eames, folder, lights, synthetic
from factorlib.generate.chair import chair, rough_chair, shell
from factorlib.generate.shapes import SHAPES
from factorlib.images.exr import read_exr, read_rgb_exr, write_rgb_exr
from factorlib.images.photo import read_photo
from factorlib.images.picture import read_png
from factorlib.light.latlong import sampled
from factorlib.meshes.mesh import area_vectors
from factorlib.meshes.read import read_mesh

pytest.importorskip("mitsuba")
TINY = synthetic.Parameters(width=96, height=64, focal_px=125.0, light_rows=16, spp=64, light_spp=2)
TINY_PHOTO = eames.Parameters(width=96, height=72, light_rows=16, spp=8, light_spp=2)


def quiet(done: int, total: int, text: str) -> None:
    pass


@pytest.fixture(scope="module")
def small(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("sets") / "small"
    synthetic.generate(out, 0, [], TINY, quiet)
    return out


@pytest.fixture(scope="module")
def chairs(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("sets") / "chairs"
    eames.generate(out, 3, [], TINY_PHOTO, quiet, eames.SET.shots[:2])
    return out


def hashes(out: Path) -> dict[str, str]:
    return {
        str(path.relative_to(out)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(out.rglob("*"))
        if path.is_file()
    }


def test_the_same_seed_is_the_same_bytes(small, tmp_path):
    synthetic.generate(tmp_path / "again", 0, [], TINY, quiet)
    assert hashes(tmp_path / "again") == hashes(small)


def test_another_seed_is_another_set(small, tmp_path):
    synthetic.generate(tmp_path / "other", 1, [], TINY, quiet)
    first, other = read_dataset(small).truth, read_dataset(tmp_path / "other").truth
    assert all(first.materials[name] != other.materials[name] for name in first.materials)
    assert all(max(m.diffuse) + max(m.specular) < 1 for m in other.materials.values())


def test_the_synthetic_set_holds_one_photo_of_each_kind_and_hides_one_pose(small):
    dataset = read_dataset(small)
    assert [Path(photo.image).suffix for photo in dataset.spec.photos] == [".exr", ".png", ".jpg"]
    hidden = [obj.name for photo in dataset.spec.photos for obj in photo.objects if obj.pose is None]
    assert hidden == ["red_blob"]
    assert set(dataset.truth.poses["study"]) == {obj.name for obj in dataset.photo("study").objects}


def test_only_the_jpeg_clips(small):
    for name, suffix in (("garden", "exr"), ("parlour", "png"), ("study", "jpg")):
        labels = read_png(small / f"masks/{name}.png")[..., 0]
        clipped = read_photo(small / f"photos/{name}.{suffix}").clipped[(labels > 0) & (labels < 255)]
        assert clipped.any() == (suffix == "jpg")
        assert clipped.mean() < 0.1


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
    light = sampled(light, lat_long_directions(height, width))
    cosine = np.maximum(np.einsum("nd,hwd->nhw", normal, lat_long_directions(height, width)), 0)
    return np.einsum("nhw,hwc,h->nc", cosine, light, lat_long_solid_angles(height, width))


def test_the_chair_set_tells_no_pose_and_links_its_photos(chairs):
    dataset = read_dataset(chairs)
    assert all(obj.pose is None for photo in dataset.spec.photos for obj in photo.objects)
    assert read_photo(chairs / "photos/terrace.jpg").focal_px == pytest.approx(folder.focal_px_of_35mm(45, 96, 72))
    assert read_photo(chairs / "photos/kitchen.jpg").focal_px is None
    assert {photo: len(poses) for photo, poses in dataset.truth.poses.items()} == {"terrace": 2, "kitchen": 1}


def test_the_mesh_given_is_coarser_and_a_few_millimetres_off(chairs):
    mesh = read_mesh(chairs / "meshes/chair.obj", ["red", "wood"], {"shell": "red", "legs": "wood"})
    fine, _ = chair()["shell"]
    rough, faces = rough_chair(np.random.default_rng(5))["shell"]
    exact, _ = shell(14, 22)
    assert len(mesh.faces) < 0.1 * sum(len(f) for _, f in chair().values())
    assert 0.0005 < np.linalg.norm(rough - exact, axis=1).mean() < 0.01
    assert np.abs(np.ptp(rough, axis=0) - np.ptp(fine, axis=0)).max() < 0.02


@pytest.mark.parametrize("vertices_and_faces", [*chair().values(), *rough_chair(np.random.default_rng(1)).values()])
def test_parts_are_closed_and_face_outward(vertices_and_faces):
    vertices, faces = vertices_and_faces
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    assert {tuple(edge) for edge in edges} == {tuple(edge[::-1]) for edge in edges}
    assert np.einsum("nd,nd->", area_vectors(vertices, faces), vertices[faces].mean(axis=1)) > 0


@pytest.mark.parametrize("name", SHAPES)
def test_normals_of_shapes_are_those_of_their_faces(name):
    mesh = SHAPES[name]()
    flat = area_vectors(mesh.vertices, mesh.faces)
    flat /= np.linalg.norm(flat, axis=1, keepdims=True)
    assert (np.einsum("fd,fkd->fk", flat, mesh.normals[mesh.faces]) > 0.7).all()


def test_borders_are_left_out_on_either_side():
    fine = np.zeros((4 * 6, 4 * 8), dtype=int)
    fine[:, 4 + 8 :] = 2  # a straight edge between the photo's columns 1 and 2
    labels = folder.whole_pixels(fine)
    assert labels.shape == (4, 6)
    assert labels[0].tolist() == [0, 255, 255, 2, 2, 2]


def test_a_users_lights_replace_the_made_ones(tmp_path):
    light = np.ones((32, 64, 3)) * [1.0, 2.0, 3.0]
    light[3, 7] = 100
    write_rgb_exr(tmp_path / "sky.exr", light)
    taken = lights.captured(tmp_path / "sky.exr", 16)
    assert taken.shape == (16, 32, 3)
    assert np.unravel_index(taken[..., 0].argmax(), (16, 32)) == (1, 3)
    assert taken.mean() == pytest.approx(1)
    write_rgb_exr(tmp_path / "square.exr", np.ones((8, 8, 3)))
    with pytest.raises(InputError, match="no lat-long"):
        lights.captured(tmp_path / "square.exr", 8)
