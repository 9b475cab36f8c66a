"""Cameras from elsewhere: a damaged or hostile COLMAP model, transforms.json or BOP scene is refused, in a moment."""

import json
import os
import struct
import time
import warnings

import numpy as np
import pycolmap
import pytest
import yaml

from factorlib.dataset.read import read_dataset
from factorlib.errors import InputError

EYE = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 5.0]]
LENS = {"fl_x": 300.0, "cx": 104.0, "cy": 71.0, "w": 200, "h": 150}
CAMERA = {"cam_K": [300.0, 0, 103.5, 0, 300.0, 70.5, 0, 0, 1.0]}
POSE = {"obj_id": 5, "cam_R_m2c": [1.0, 0, 0, 0, 1.0, 0, 0, 0, 1.0], "cam_t_m2c": [0.0, 0.0, 1500.0]}


@pytest.fixture
def folder(tmp_path):
    for name in ("7.png", "mask.png", "chair.ply"):
        (tmp_path / name).write_text("")
    (tmp_path / "model").mkdir()
    return tmp_path


def read(folder, **cameras):
    photo = {"name": "hall", "image": "7.png", "masks": "mask.png", "objects": [{"name": "chair", "mesh": "chair"}]}
    spec = {"format": 1, "materials": ["red"], "meshes": {"chair": {"file": "chair.ply", "material": "red"}}, "photos": [photo]}
    (folder / "dataset.yaml").write_text(yaml.safe_dump(spec | {"cameras": cameras}))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return read_dataset(folder)


def refused(folder, **cameras):
    begin = time.process_time()
    with pytest.raises(InputError) as caught:
        read(folder, **cameras)
    assert caught.value.cure and caught.value.file and len(str(caught.value)) < 1000
    assert time.process_time() - begin < 10
    return caught.value


# ── COLMAP ───────────────────────────────────────────────────────────────────────────────────────────────────────────

NUMBERS = (0.7, 0.1, -0.5, 0.5, 1.0, 2.0, 3.0)  # a unit quaternion and a translation


def binary(folder, cameras=1, images=1, points=0, model=0, width=200, height=150, params=(300.0, 104.0, 71.0), numbers=NUMBERS, camera_id=1):
    head = struct.pack("<QIiQQ", cameras, 1, model, width, height)
    (folder / "model/cameras.bin").write_bytes(head + struct.pack(f"<{len(params)}d", *params))
    image = struct.pack("<QI7dI", images, 1, *numbers, camera_id) + b"7.png\0" + struct.pack("<Q", points)
    (folder / "model/images.bin").write_bytes(image)
    return folder


def text(folder, camera="1 SIMPLE_PINHOLE 200 150 300 104 71", image="1 .7 .1 -.5 .5 1 2 3 1 7.png"):
    (folder / "model/cameras.txt").write_text(f"# cameras\n{camera}\n")
    (folder / "model/images.txt").write_text(f"# images\n{image}\n\n")
    return folder


@pytest.mark.parametrize("form", [binary, text])
def test_poses_are_those_that_pycolmap_reads(folder, form):
    (form(folder) / "model" / f"points3D.{'bin' if form is binary else 'txt'}").write_bytes(bytes(8) if form is binary else b"")
    external = read(folder, colmap="model", world_from_object={"chair": {}}).external["hall"]
    model = pycolmap.Reconstruction(str(folder / "model"))
    rigid = model.images[1].cam_from_world()
    assert np.allclose(external.poses["chair"].rotation, rigid.rotation.matrix(), atol=1e-15)
    assert np.allclose(external.poses["chair"].translation, rigid.translation)
    assert (external.focal_px, external.principal_point, external.size) == (300.0, (104.0, 71.0), (200, 150))


@pytest.mark.parametrize("count", [2, 10**7, 2**40, 2**63, 2**64 - 1])
@pytest.mark.parametrize("of", ["cameras", "images", "points"])
def test_a_count_is_not_taken_at_its_word(folder, count, of):
    assert "not readable as a COLMAP model" in refused(binary(folder, **{of: count}), colmap="model").found


@pytest.mark.parametrize(
    "wrong, words",
    [
        ({"model": 77}, "77 is no camera model"),
        ({"model": -1}, "-1 is no camera model"),
        ({"width": 0}, "is no camera"),
        ({"height": 2**64 - 1}, "is no camera"),
        ({"params": (1e300, 104.0, 71.0)}, "is no camera"),
        ({"params": (1e-300, 104.0, 71.0)}, "no photo's"),
        ({"params": (-300.0, 104.0, 71.0)}, "is no camera"),
        ({"params": (float("nan"), 104.0, 71.0)}, "is no camera"),
        ({"params": (300.0, 1e9, 71.0)}, "no photo's"),
        ({"params": (300.0,)}, "not readable as a COLMAP model"),
        ({"numbers": (0.0,) * 7}, "is no pose"),
        ({"numbers": (*NUMBERS[:6], float("inf"))}, "is no pose"),
        ({"numbers": (1e300, *NUMBERS[1:])}, "is no pose"),
        ({"camera_id": 9}, "has camera 9"),
    ],
)
def test_a_model_that_is_none(folder, wrong, words):
    assert words in refused(binary(folder, **wrong), colmap="model").found


@pytest.mark.parametrize(
    "wrong",
    [
        {"camera": "1 SIMPLE_PINHOLE 200 150 300 104"},
        {"camera": "1 NONE 200 150 300 104 71"},
        {"camera": "1 SIMPLE_PINHOLE -200 150 300 104 71"},
        {"camera": "1 SIMPLE_PINHOLE " + "9" * 5000 + " 150 300 104 71"},
        {"camera": "1"},
        {"image": "1 .7 .1 -.5 .5 1 2 3 1"},
        {"image": "1 .7 .1 -.5 .5 3 1 7.png"},
        {"image": "1 nan .1 -.2 .3 1 2 3 1 7.png"},
        {"image": "1 one .1 -.2 .3 1 2 3 1 7.png"},
        {"image": "\x00"},
    ],
)
def test_a_model_in_text_that_is_none(folder, wrong):
    refused(text(folder, **wrong), colmap="model")


def test_a_model_that_is_no_text(folder):
    text(folder)
    (folder / "model/images.txt").write_bytes(b"\xff\xfe\x00")
    refused(folder, colmap="model")


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin"])
def test_a_model_of_a_pipe_or_a_link_that_leads_out(folder, name):
    binary(folder)
    (folder / "model" / name).unlink()
    os.mkfifo(folder / "model" / name)
    assert "is a pipe" in refused(folder, colmap="model").found
    (folder / "model" / name).unlink()
    (folder / "model" / name).symlink_to("/etc/passwd")
    assert "outside the dataset" in refused(folder, colmap="model").found


# ── transforms.json ──────────────────────────────────────────────────────────────────────────────────────────────────


def transforms(folder, lens=LENS, matrix=EYE, content=None):
    frames = [{"file_path": "7", "transform_matrix": matrix}]
    (folder / "t.json").write_text(content if content is not None else json.dumps({**lens, "frames": frames}))
    return folder


@pytest.mark.parametrize(
    "lens, key",
    [
        ({"camera_angle_x": 0.0}, "frames[0].camera_angle_x"),
        ({"camera_angle_x": 0.0, "w": 200, "h": 150}, "frames[0].camera_angle_x"),
        ({"camera_angle_x": -1.0}, "frames[0].camera_angle_x"),
        ({"camera_angle_x": 1e-300}, "frames[0]"),
        ({"camera_angle_x": 1e-300, "w": 200, "h": 150}, "frames[0].camera_angle_x"),
        ({"camera_angle_x": 4.0}, "frames[0].camera_angle_x"),
        (LENS | {"w": 1e30}, "w"),
        (LENS | {"w": 1e12}, "frames[0].w"),
        (LENS | {"w": -200}, "frames[0].w"),
        (LENS | {"h": 0}, "frames[0].h"),
        (LENS | {"w": 0.4}, "frames[0].w"),
        (LENS | {"fl_x": 1e300}, "fl_x"),
        (LENS | {"fl_x": 1e-300}, "frames[0].fl_x"),
        (LENS | {"fl_y": -3}, "frames[0].fl_y"),
        (LENS | {"cx": 1e9}, "frames[0].cx"),
        ({"fl_x": 300.0, "cx": -1e9, "cy": 0.0}, "frames[0].cx"),
        (LENS | {"k1": 1e14}, "t.json: frames[0]"),
        (LENS | {"k1": 1e14, "is_fisheye": True}, "t.json: frames[0]"),
        (LENS | {"camera_model": "X" * 10_000}, "frames[0].camera_model"),
    ],
)
def test_a_lens_that_is_none(folder, lens, key):
    assert refused(transforms(folder, lens), transforms="t.json").key == key


@pytest.mark.parametrize(
    "content",
    ["[" * 100_000, "{" + '"a":{' * 100_000, '{"a":' * 500 + "1" + "}" * 500, "", "\x00", "[]", "null", '{"frames": null}', '{"w": ' + "1" * 5000 + "}",
     '{"frames": [{"file_path": 5}]}', '{"frames": "x"}', '{"frames": [[]]}'],
    ids=range(12),
)  # fmt: skip
def test_a_json_that_is_none(folder, content):
    assert "t.json" in str(refused(transforms(folder, content=content), transforms="t.json").file)


@pytest.mark.parametrize("matrix", [[[1e300, 0, 0, 0]] * 3, [[0, 0, 0, 0]] * 3, [], [[1, 0, 0]] * 3])
def test_a_matrix_that_is_none(folder, matrix):
    refused(transforms(folder, matrix=matrix), transforms="t.json")


def test_what_else_stands_in_a_json_is_left_alone(folder):
    """A time stamp in nanoseconds is larger than any length."""
    assert read(transforms(folder, {**LENS, "stamp": 1.7e18, "note": [[[]]]}), transforms="t.json").external["hall"].focal_px == 300


# ── BOP ──────────────────────────────────────────────────────────────────────────────────────────────────────────────


def bop(folder, cameras=None, poses=None):
    (folder / "model/scene_camera.json").write_text(json.dumps({"7": CAMERA} if cameras is None else cameras))
    (folder / "model/scene_gt.json").write_text(json.dumps({"7": [POSE]} if poses is None else poses))
    return folder


@pytest.mark.parametrize("name", ["²", "٣", "", "-1", "7" * 5000, "x" * 10_000])
def test_an_id_that_is_none(folder, name):
    assert "not the id of an image" in refused(bop(folder, {name: CAMERA}), bop="model").found


@pytest.mark.parametrize(
    "cameras, poses",
    [
        ({"7": {"cam_K": [1e300, 0, 103.5, 0, 1e300, 70.5, 0, 0, 1.0]}}, None),
        ({"7": {"cam_K": [1e-300, 0, 103.5, 0, 1e-300, 70.5, 0, 0, 1.0]}}, None),
        ({"7": {"cam_K": [300, 0, 1e9, 0, 300, 70.5, 0, 0, 1.0]}}, None),
        ([], None),
        (None, {"7": [POSE | {"cam_t_m2c": [0, 0, 1e300]}]}),
        (None, {"7": [POSE | {"obj_id": "5"}]}),
        (None, {"7": POSE}),
    ],
)
def test_a_scene_that_is_none(folder, cameras, poses):
    refused(bop(folder, cameras, poses), bop="model", obj_ids={"chair": 5})


@pytest.mark.parametrize("name", ["scene_camera.json", "scene_gt.json"])
def test_a_scene_that_leads_out_of_the_dataset(folder, tmp_path_factory, name):
    """By a link in the scene's folder."""
    bop(folder)
    outside = tmp_path_factory.mktemp("outside") / name
    (folder / "model" / name).rename(outside)
    (folder / "model" / name).symlink_to(outside)
    error = refused(folder, bop="model")
    assert "outside the dataset" in error.found and error.key == "cameras.bop"
    (folder / "model" / name).unlink()
    os.mkfifo(folder / "model" / name)
    assert "is a pipe" in refused(folder, bop="model").found


def test_a_photo_named_by_a_superscript_is_looked_for(folder):
    (folder / "7.png").rename(folder / "².png")
    bop(folder)
    photo = {"name": "hall", "image": "².png", "masks": "mask.png", "objects": [{"name": "chair", "mesh": "chair"}]}
    spec = {"format": 1, "materials": ["red"], "meshes": {"chair": {"file": "chair.ply", "material": "red"}}, "photos": [photo]}
    (folder / "dataset.yaml").write_text(yaml.safe_dump(spec | {"cameras": {"bop": "model"}}))
    with pytest.raises(InputError, match="none of its 1 images"):
        read_dataset(folder)


def test_thousands_of_photos_find_their_images_in_a_moment(folder):
    from factorlib.dataset.schema import CameraSource, DatasetFile, PhotoEntry
    from factorlib.dataset.sources.external import matched
    from factorlib.dataset.sources.shot import Shot

    photos = [PhotoEntry(name=f"p{i}", image=f"photos/p{i}.png", masks="m.png") for i in range(5000)]
    shots = [Shot(image=f"images/p{i}.jpg", camera=None, size=None, key="") for i in range(5000)]
    begin = time.process_time()
    found = matched(DatasetFile(1, [], photos, cameras=CameraSource()), "colmap", shots, None)
    assert [shot.image for shot in found.values()] == [f"images/p{i}.jpg" for i in range(5000)]
    assert time.process_time() - begin < 5
