"""The files of `surface`, and what later stages make of them."""

import msgspec
import numpy as np
import pytest

from factorlib.dataset.schema import MeshEntry
from factorlib.generate.solids import sphere
from factorlib.geometry.sphere import ball_normals
from factorlib.images.exr import write_exr
from factorlib.inference.model.blocks import Noise
from factorlib.inference.model.observed import blocks_of_observations, gather_observations
from factorlib.jsonfile import read_json, write_json
from factorlib.meshes.ply_stl_off import write_ply
from factorlib.meshes.read_mesh import CREASE_DEG, MeshCache, read_mesh
from factorlib.meshes.subdivision import subdivided_mesh
from factorlib.results.surface_table import SurfaceTable, read_surface
from factorlib.stage import serial_map, silent
from factorlib.urm.extract import read_geometry, with_surface_normals
from factorlib.urm.observations import Observations, read_observations, write_observations
from stages import surface
from tests.evaluate.made_artifacts import Made, make_artifacts
from tests.inference.made import observations_from_front
from tests.refusal import refusal
from tests.stages.made import ran

SIZE = 12


def observations() -> Observations:
    """A pixel each of two rows, normals toward the camera."""
    x, y = (of.reshape(-1).astype("i4") for of in np.meshgrid(np.arange(SIZE), np.arange(SIZE)))
    front, none = np.tile(np.float32([0, 0, -1]), (len(x), 1)), np.zeros(len(x), int)
    return observations_from_front(front, np.full((len(x), 3), 0.5, "f4"), none, ("red",), "a", x=x, y=y)


def written(folder) -> None:
    """A surface that leans to the right and is half as bright on its left half; its first row shows no mesh."""
    normal = np.tile([0.6, 0.0, -0.8], (SIZE, SIZE, 1))
    normal[0] = 0
    detail = np.where(np.arange(SIZE) < SIZE // 2, 0.5, 1.0) * np.ones((SIZE, 1))
    channels = {f"normal.{a}": normal[..., k] for k, a in enumerate("xyz")} | {f"detail.{c}": detail for c in "RGB"}
    (folder / "photos").mkdir(parents=True)
    write_exr(folder / "photos" / "a.exr", channels)


def detail_names() -> list[str]:
    """Channels of the detail of the reflectance."""
    return [f"detail.{channel}" for channel in "RGB"]


def test_observations_and_maps_have_the_normals_and_the_detail_of_the_surface(tmp_path):
    written(tmp_path / "surface")
    observed = with_surface_normals(observations(), tmp_path / "surface")
    first = observed.y == 0
    np.testing.assert_allclose(observed.normal[~first], np.tile([0.6, 0, -0.8], ((~first).sum(), 1)), atol=1e-6)
    assert (observed.normal[first] == [0, 0, -1]).all() and (observed.detail[first] == 1).all()
    assert (observed.detail[~first & (observed.x < 6)] == 0.5).all() and (observed.detail[observed.x >= 6] == 1).all()
    (tmp_path / "align").mkdir()
    write_exr(
        tmp_path / "align" / "a.exr",
        {f"normal.{a}": np.ones((SIZE, SIZE)) for a in "xyz"} | {"depth": np.ones((SIZE, SIZE))},
    )
    maps = read_geometry(tmp_path / "align", tmp_path / "surface", "a")
    assert set(maps) == {"normal.x", "normal.y", "normal.z", "depth", *(f"detail.{c}" for c in "RGB")}
    assert maps["normal.x"][3, 3] == np.float32(0.6)
    assert "detail.R" not in read_geometry(tmp_path / "align", None, "a")
    assert (
        with_surface_normals(observations(), None) is not None
        and with_surface_normals(observations(), None).detail is None
    )
    wide = msgspec.structs.replace(observations(), x=observations().x + 1)
    refusal("12 × 12", with_surface_normals, wide, tmp_path / "surface")


def test_all_choices_of_materials_of_a_textured_mesh_have_the_same_faces(tmp_path):
    write_ply(tmp_path / "ball.ply", sphere(1.0))
    dense = subdivided_mesh(read_mesh(tmp_path / "ball.ply", ["red"], "red"), 0.03)
    textures = {"ball": (0.03, {"red": np.full((dense.nodes, 3), 0.5)})}
    read = MeshCache(lambda _, file: tmp_path / file, ["red", "blue"], CREASE_DEG, textures=textures)
    red, blue = (read.mesh("ball", MeshEntry("ball.ply", material="red"), {"ball": m}) for m in ("red", "blue"))
    assert np.array_equal(red.faces, blue.faces) and np.unique(red.detail) == 0.5 and blue.detail is None


def test_the_solve_merges_only_what_has_one_detail_and_its_blocks_reflect_by_it(tmp_path):
    written(tmp_path / "surface")
    write_observations(tmp_path / "a.parquet", observations())
    (photo,) = gather_observations([tmp_path / "a.parquet"], 2.0, serial_map, tmp_path / "surface")
    assert np.unique(photo.merged.detail).tolist() == [0.5, 1.0]
    (block,) = blocks_of_observations(photo.merged, Noise())
    assert np.array_equal(np.sort(block.detail, 0), np.sort(photo.merged.detail, 0))
    plain = msgspec.structs.replace(photo.merged, detail=None)
    assert blocks_of_observations(plain, Noise())[0].detail is None


def test_the_last_digits_of_estimated_normals_decide_nothing(tmp_path):
    """Observations that are merged, held out and drawn are the same on processors that round otherwise."""
    normals, inside = ball_normals(48)
    y, x = (of.astype("i4") for of in np.nonzero(inside))
    radiance = np.full((len(x), 3), 0.5, "f4")
    normals[:, 1:] *= -1  # to the camera's frame
    pixels = observations_from_front(normals.astype("f4"), radiance, 0 * x, ("red",), "a", x=x, y=y)
    write_observations(tmp_path / "a.parquet", pixels)
    samples = []
    for number in range(2):
        turned = normals + [0.1, 0, 0] + np.random.default_rng(number).normal(0, 1e-3, normals.shape)
        maps = {name: np.zeros(inside.shape) for name in ("normal.x", "normal.y", "normal.z", *detail_names())}
        for axis, values in zip("xyz", (turned / np.linalg.norm(turned, axis=1, keepdims=True)).T, strict=True):
            maps[f"normal.{axis}"][inside] = values
        (folder := tmp_path / str(number) / "photos").mkdir(parents=True)
        write_exr(folder / "a.exr", maps | dict.fromkeys(detail_names(), inside.astype(float)))
        (photo,) = gather_observations([tmp_path / "a.parquet"], 8.0, serial_map, folder.parent)
        (block,) = blocks_of_observations(photo.merged, Noise())
        samples.append(block.subsample(200, seed=0))
    first, second = samples
    assert len(first) < len(block) < len(pixels)  # some are merged, and some of these are drawn
    for name in ("row", "held_out", "inverse_sigma", "view"):
        assert np.array_equal(getattr(first, name), getattr(second, name)), name
    assert 0 < np.abs(first.normal - second.normal).max() < 0.01


def test_off_changes_nothing_and_selects_lights_where_there_are_many(tmp_path):
    inputs = make_artifacts(Made(tmp_path, {"day": ["red"], "noon": ["red", "white"]}))
    assert read_surface(ran(surface, inputs, tmp_path / "all", shape="off")) == SurfaceTable() == read_surface(None)
    out = ran(surface, inputs, tmp_path / "one", shape="off", lights=1)
    assert read_surface(out) == SurfaceTable(lights=["noon"])
    assert [path.name for path in out.iterdir()] == ["surface.json"]


def test_without_any_observation_the_doubtful_poses_are_named_that_were_left_out(tmp_path):
    inputs = make_artifacts(Made(tmp_path, {"day": ["red"], "noon": ["red"]}))
    for name in ("day", "noon"):
        write_observations(
            inputs["urm"] / f"{name}.parquet", read_observations(inputs["urm"] / f"{name}.parquet").take([])
        )
    refusal("no valid observation in any photo", surface.main, surface.Params(), inputs, tmp_path, silent)
    poses = read_json(inputs["align"] / "poses.json")
    poses["noon"]["objects"]["balls"] |= {"left_out": True, "doubts": ["it is mirrored"]}
    write_json(inputs["align"] / "poses.json", poses)
    error = refusal("are left out: 'balls' in 'noon'", surface.main, surface.Params(), inputs, tmp_path, silent)
    assert "align.keep_doubtful=true" in error.cure


@pytest.mark.long
def test_a_held_out_photo_takes_no_part_whatever_it_shows(tmp_path):
    inputs = make_artifacts(Made(tmp_path, {"day": ["red"], "noon": ["red"], "dusk": ["red"]}, held_out=("dusk",)))
    dusk = read_observations(inputs["urm"] / "dusk.parquet")
    other = msgspec.structs.replace(dusk, radiance=3 * dusk.radiance[::-1], normal=dusk.normal[::-1])
    results = []
    for name, shown in {"one": dusk, "other": other}.items():
        write_observations(inputs["urm"] / "dusk.parquet", shown)
        out = ran(surface, inputs, tmp_path / name, observations=60)
        results.append([(out / file).read_bytes() for file in ("surface.json", "beginning.json")])
    assert results[0] == results[1]


def test_meshes_are_moved_and_painted_wherever_they_are_read(tmp_path):
    write_ply(tmp_path / "ball.ply", sphere(1.0))
    dense = subdivided_mesh(read_mesh(tmp_path / "ball.ply", ["red"], "red"))
    moves, factors = ({"ball": np.full(shape, 0.05).tolist()} for shape in (dense.nodes, (dense.nodes, 3)))
    once = MeshCache(lambda _, file: tmp_path / file, ["red"], CREASE_DEG, moves, factors)
    mesh = once.mesh("ball", MeshEntry("ball.ply", material="red"))
    radius = np.linalg.norm(mesh.vertices, axis=1).max()
    assert abs(radius - 1 - 0.05 * dense.extent) < 1e-3 and np.allclose(mesh.detail, np.exp(0.05))
    write_ply(tmp_path / "moved.ply", mesh)
    again = read_mesh(tmp_path / "moved.ply", ["red"], "red")
    assert np.isclose(np.linalg.norm(again.vertices, axis=1).max(), radius)
    other = MeshCache(lambda _, file: tmp_path / file, ["red"], CREASE_DEG, {"ball": [0.0] * 7})
    refusal("surface", other.mesh, "ball", MeshEntry("ball.ply", material="red"))
