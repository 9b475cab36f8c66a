"""The urm stage from masks, align's maps and meshes to observations with visibility."""

import msgspec
import numpy as np
import pytest
import trimesh

from factorlib.geometry.camera import Camera, Pose
from factorlib.geometry.raster import rasterise
from factorlib.images.exr import read_exr, read_rgb_exr, write_exr
from factorlib.jsonfile import write_json
from factorlib.meshes.mesh import Mesh
from factorlib.meshes.ply_stl_off import write_ply
from factorlib.results.poses import ObjectPose
from factorlib.stage import Inputs
from factorlib.urm.observations import read_observations
from factorlib.urm.reduction import sample
from stages import urm
from tests.align.scenes import ball, mesh_of
from tests.stages.made import poses_of, ran, write_aligned

CAMERA = Camera(80, 60, 90.0, (40.0, 30.0))
LEFT, RIGHT = Pose(np.eye(3), np.array([-1.05, 0.0, 6.0])), Pose(np.eye(3), np.array([1.05, 0.0, 6.0]))


def step(folder, poses: dict[str, Pose]):
    """Inputs of a photo of white balls."""
    mesh = mesh_of([ball(1.0, 3)])
    maps = rasterise([mesh] * len(poses), CAMERA, list(poses.values()))
    inside = (maps.label > 0).astype("f4")
    for stage in ("masks", "align"):
        (folder / stage).mkdir(parents=True)
    write_aligned(folder / "align", "a", maps)
    channels = dict.fromkeys("RGB", inside) | {"left_out": 0 * inside} | {f"clipped.{c}": 0 * inside for c in "RGB"}
    write_exr(folder / "masks" / "a.exr", {**channels, "label": maps.label, "valid": inside})
    size = [CAMERA.width, CAMERA.height]
    write_json(folder / "masks" / "a.json", {"width": size[0], "height": size[1], "factor": 1, "original_size": size})
    write_json(folder / "align" / "a.json", poses_of(CAMERA, **poses))
    write_ply(folder / "ball.ply", mesh)
    facts = {
        "dataset.materials": ["white"],
        "dataset.light": {"illumination": "room", "world_from_camera": None},
        "dataset.ground": {"ground": None},
        "dataset.objects": {
            "camera": {},
            "objects": [{"name": name, "mesh": "ball"} for name in poses],
            "meshes": {"ball": {"file": "ball.ply", "material": "white"}},
        },
    }
    folders = {stage: folder / stage for stage in ("masks", "align")}
    return Inputs(folders, facts, {"ball.ply": folder / "ball.ply"}, "a")


def run(folder, inputs, **params):
    return ran(urm, inputs, folder, **params) / "a.parquet"


@pytest.fixture(scope="module")
def two(tmp_path_factory):
    return step(tmp_path_factory.mktemp("two"), {"left": LEFT, "right": RIGHT})


@pytest.fixture(scope="module")
def whole(tmp_path_factory, two):
    return run(tmp_path_factory.mktemp("whole") / "out", two)


def test_one_ball_sees_everything_and_its_file_says_nothing_of_visibility(tmp_path):
    inputs = step(tmp_path, {"left": LEFT})
    one, other = run(tmp_path / "1", inputs), run(tmp_path / "2", inputs, directions=0)
    assert read_observations(one).visibility is None and one.read_bytes() == other.read_bytes()


def test_two_balls_hide_each_other_where_they_face_in_the_same_bytes_again(tmp_path, two, whole):
    observed = read_observations(whole)
    hidden, left = (observed.visibility < 255).mean(1), observed.x < 40
    assert observed.visibility.shape[1] == urm.Params().directions
    assert hidden[left & (observed.normal[:, 0] > 0.6)].min() > hidden[left & (observed.normal[:, 0] < -0.2)].max()
    assert (hidden[~left & (observed.normal[:, 0] > 0.2)] == 0).all()
    assert run(tmp_path / "again", two).read_bytes() == whole.read_bytes()


def test_of_many_pixels_a_weighted_sample_is_written_with_its_visibility(tmp_path, two, whole, monkeypatch):
    whole = read_observations(whole)
    monkeypatch.setattr(urm, "sample", lambda observed, most: sample(observed, 600))
    part = read_observations(run(tmp_path / "part", two))
    assert len(whole) > 1000 > len(part) == 600
    assert part.weight.sum() == pytest.approx(whole.weight.sum(), rel=1e-5) == pytest.approx(len(whole), rel=1e-5)
    place = {(x, y): k for k, (x, y) in enumerate(zip(whole.x.tolist(), whole.y.tolist()))}
    rows = [place[at] for at in zip(part.x.tolist(), part.y.tolist())]
    np.testing.assert_array_equal(part.visibility, whole.visibility[rows])


def test_the_surroundings_are_written_with_the_observations_and_black_ones_say_nothing(tmp_path, two):
    assert not read_rgb_exr(run(tmp_path / "black", two).parent / "background" / "a.exr").any()
    channels = read_exr(two["masks"] / "a.exr")
    grey = {c: np.where(channels["label"] > 0, channels[c], 0.25) for c in "RGB"}
    (tmp_path / "masks").mkdir()
    write_exr(tmp_path / "masks" / "a.exr", channels | grey)
    (tmp_path / "masks" / "a.json").write_bytes((two["masks"] / "a.json").read_bytes())
    photo = msgspec.structs.replace(two, folders={**two.folders, "masks": tmp_path / "masks"})
    found = read_rgb_exr(run(tmp_path / "grey", photo).parent / "background" / "a.exr")
    assert found.any() and np.allclose(found[found.any(-1)], 0.25)


@pytest.mark.parametrize("height, stands", [(0.0, True), (0.04, True), (0.2, False), (-0.2, False)])
def test_objects_of_which_one_hovers_have_no_ground(two, height, stands):
    """Boxes whose diagonal is √3."""
    solid = trimesh.creation.box()
    box = Mesh(np.asarray(solid.vertices), np.asarray(solid.faces), np.zeros((8, 3)), np.ones(12, np.int16))
    poses = {
        name: msgspec.convert({"rotation": np.eye(3).tolist(), "translation": place}, ObjectPose)
        for name, place in {"left": (-1, 0, 6), "right": (1, -height * 3**0.5, 6)}.items()
    }
    ground = urm.ground_plane(two, dict.fromkeys(poses, box), poses)
    assert (ground is not None) == stands
    if ground is not None:
        np.testing.assert_allclose(ground.normal, [0, -1, 0], atol=1e-6)
        assert ground.point[1] == pytest.approx(0.5)
