"""The stage `texture`: paint comes back at every pixel and in the meshes of exports, and plain things stay plain."""

from functools import partial
from pathlib import Path

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from factorlib.dataset.schema import MeshEntry
from factorlib.geometry.camera import Camera, Pose
from factorlib.geometry.raster import rasterise
from factorlib.images.exr import read_exr, write_exr
from factorlib.jsonfile import write_json
from factorlib.meshes.read_mesh import CREASE_DEG, MeshCache, read_mesh
from factorlib.reflection import reflection_operator
from factorlib.reflection.network import SHIPPED
from factorlib.render.resynthesis import Reflector
from factorlib.results.materials import Reflectance
from factorlib.results.texture_table import TextureTable, read_table, read_textures
from factorlib.stage import Inputs
from stages import shading, texture
from tests.export.made_export import light, write_obj
from tests.refusal import refusal
from tests.runner.toy import files_of
from tests.stages.made import poses_of, ran, write_aligned, write_solution

CAMERA = Camera(48, 48, 68.0, (24.0, 24.0))
TURNS = {"a": 0.0, "b": 35.0, "c": -40.0}
MATERIAL = {"diffuse": [0.5, 0.4, 0.3], "specular": [0.04, 0.04, 0.04], "roughness": 0.4}


def stripes(place: np.ndarray) -> np.ndarray:
    """Paint of a ball by place in its own frame."""
    return np.exp(0.5 * np.sin(4 * place[:, [1]] + [0.0, 1.0, 2.0]))


def photographed(folder: Path, paint) -> Inputs:
    """What the stages before leave of three photos of a painted ball, each in a light of its own."""
    for stage in ("align", "masks", "solve", "shading"):
        (folder / stage).mkdir(parents=True)
    write_obj(folder / "ball.obj", (1, 1, 1), rows=28)
    ball = read_mesh(folder / "ball.obj", ["red"], "red")
    lights = {name: light(k) for k, name in enumerate(TURNS)}
    entry = {"camera": {}, "objects": [{"name": "ball", "mesh": "ball"}]}
    entry["meshes"] = {"ball": {"file": "ball.obj", "material": "red"}}
    poses = {}
    for name, degrees in TURNS.items():
        pose = Pose(Rotation.from_euler("y", degrees, degrees=True).as_matrix(), np.array([0.0, 0.0, 4.0]))
        maps = rasterise(ball, CAMERA, pose)
        y, x = np.nonzero(maps.label > 0)
        point = CAMERA.rays_through(np.column_stack([x, y]) + 0.5)
        point = point / point[:, 2:] * maps.depth[y, x, None]
        reflect = Reflector(reflection_operator("network"), lights[name])
        radiance = np.zeros((CAMERA.height, CAMERA.width, 3))
        normals, views = (each[y, x].astype(float) for each in (maps.normal, maps.view))
        diffuse, specular = reflect.parts(Reflectance(**MATERIAL), normals, views)
        radiance[y, x] = diffuse * paint((point - pose.translation) @ pose.rotation) + specular
        inside = (maps.label > 0).astype(float)
        write_aligned(folder / "align", name, maps)
        photo = dict(zip("RGB", np.moveaxis(radiance, -1, 0))) | {"label": maps.label, "valid": inside}
        write_exr(folder / "masks" / f"{name}.exr", photo | {f"clipped.{c}": 0 * inside for c in "RGB"})
        poses[name] = poses_of(CAMERA, ball=pose)
    write_json(folder / "align" / "poses.json", poses)
    write_solution(folder / "solve", {"red": MATERIAL}, lights, {})
    facts = {"dataset.materials": ["red"], "dataset.objects": dict.fromkeys(TURNS, entry)}
    facts["dataset.light"] = {name: {"illumination": name, "world_from_camera": None} for name in TURNS}
    folders = {stage: folder / stage for stage in ("align", "masks", "solve", "shading")} | {"train": SHIPPED}
    inputs = Inputs(folders, facts, {"ball.obj": folder / "ball.obj"})
    for name in TURNS:
        slices = facts | {"dataset.light": facts["dataset.light"][name]}
        of_photo = msgspec.structs.replace(inputs, facts=slices, photo=name)
        ran(shading, of_photo, folders["shading"])
    return inputs


run = partial(ran, texture)


@pytest.fixture(scope="module")
def painted(tmp_path_factory):
    folder = tmp_path_factory.mktemp("painted")
    inputs = photographed(folder / "set", stripes)
    return inputs, run(inputs, folder / "out")


def test_paint_comes_back_at_every_pixel_and_in_the_mesh(painted):
    inputs, out = painted
    table = read_table(out)
    assert [(t.mesh, t.material, t.kept, t.photos) for t in table.textures] == [("ball", "red", True, 3)]
    cache = MeshCache(lambda _, file: inputs.files[file], ["red"], CREASE_DEG, textures=read_textures(out))
    mesh = cache.mesh("ball", MeshEntry("ball.obj", material="red"))
    front = mesh.vertices[:, 2] < -0.5  # what photos show: they look along z
    error = np.abs(mesh.detail / stripes(mesh.vertices) - 1)[front]
    assert np.median(error) < 0.03 and np.quantile(error, 0.9) < 0.1
    for name in TURNS:
        maps, label = read_exr(out / "photos" / f"{name}.exr"), read_exr(inputs["align"] / f"{name}.exr")["label"]
        assert set(maps) == {"detail.R", "detail.G", "detail.B"}
        assert all(((maps[channel] > 0) == (label > 0)).all() for channel in maps)


def test_the_same_bytes_again(painted, tmp_path):
    inputs, out = painted
    assert files_of(run(inputs, tmp_path / "again")) == files_of(out)


def test_a_plain_thing_has_no_texture_and_off_asks_nothing(painted, tmp_path):
    inputs = photographed(tmp_path / "set", lambda place: np.ones_like(place))
    out = run(inputs, tmp_path / "plain")
    (decision,) = read_table(out).textures
    assert not decision.kept and [path.name for path in out.iterdir()] == ["texture.json"]
    assert read_textures(out) == {}
    assert read_table(run(painted[0], tmp_path / "off", albedo="off")) == TextureTable() == read_table(None)


def test_another_mesh_than_the_textured_one_is_refused(painted):
    inputs, out = painted
    write_obj(inputs.files["ball.obj"].with_name("other.obj"), (1, 1, 1), rows=20)
    cache = MeshCache(
        lambda *_: inputs.files["ball.obj"].with_name("other.obj"), ["red"], CREASE_DEG, textures=read_textures(out)
    )
    refusal("run `texture` again", cache.mesh, "ball", MeshEntry("other.obj", material="red"))
