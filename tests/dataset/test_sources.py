"""Cameras from elsewhere: a known point lands where the source's own tool puts it, and what cannot be used is refused."""

import json
import logging
import math
import time

import numpy as np
import pycolmap
import pytest
import yaml
from scipy.spatial.transform import Rotation

from factorlib.align.given import focal_and_centre
from factorlib.dataset.read import read_dataset
from factorlib.dataset.schema import CameraSource, DatasetFile, ExternalCamera, PhotoEntry
from factorlib.dataset.slices import dataset_slice
from factorlib.dataset.sources.external import matched
from factorlib.dataset.sources.shot import Shot
from factorlib.errors import InputError
from factorlib.geometry.camera import Camera, Pose

SIZE = 200, 150
POINTS = np.array([[0.3, -0.2, 0.1], [-0.4, 0.1, 0.6], [0.0, 0.5, -0.3]])
TURN = Rotation.from_rotvec([0.4, -0.9, 0.3]).as_matrix()
NINE = [1.0, 0, 0, 0, 1.0, 0, 0, 0, 1.0]
PHOTOS = ("hall", "attic")


@pytest.fixture
def folder(tmp_path):
    path = tmp_path / "set"
    (path / "photos").mkdir(parents=True)
    for name in ("photos/hall.png", "photos/attic.png", "photos/000007.png", "mask.png", "chair.ply"):
        (path / name).write_text("")
    (tmp_path / "elsewhere").mkdir()
    return path


def write(folder, cameras, objects=({"name": "chair", "mesh": "chair"},), names=PHOTOS, photo=None):
    """A dataset of photos with a source of cameras; `photo` is laid over the first."""
    photos = [
        {"name": name, "image": f"photos/{name}.png", "masks": "mask.png", "objects": list(objects)} for name in names
    ]
    photos[0] |= photo or {}
    for entry in photos:
        entry["name"] = entry["name"].replace("000007", "seven")
    spec = {
        "format": 1,
        "materials": ["red"],
        "meshes": {"chair": {"file": "chair.ply", "material": "red"}},
        "photos": photos,
    }
    (folder / "dataset.yaml").write_text(yaml.safe_dump(spec | {"cameras": cameras}))
    return folder


def seen(external, points, name="chair", size=SIZE):
    """Where the photo shows points of the mesh, by the external camera."""
    focal, centre = focal_and_centre(external, *size, "hall")
    pose = external.poses[name]
    return Camera(*size, focal, centre).project(Pose(np.array(pose.rotation), np.array(pose.translation)).apply(points))


# ---- COLMAP --------------------------------------------------------------------------------------------------


def colmap(
    folder,
    names=("hall.png", "attic.png"),
    form="binary",
    model="SIMPLE_PINHOLE",
    params=(300.0, 104.0, 71.0),
    where="sparse/0",
):
    """A model of a camera that stands at different places; it is also returned."""
    made = pycolmap.Reconstruction()
    made.add_camera_with_trivial_rig(
        pycolmap.Camera(model=model, width=SIZE[0], height=SIZE[1], params=params, camera_id=1)
    )
    for number, name in enumerate(names, start=1):
        rigid = pycolmap.Rigid3d(
            pycolmap.Rotation3d(Rotation.from_rotvec([0.1, number, -0.2]).as_matrix()), [0.2, -0.1, 4.0 + number]
        )
        made.add_image_with_trivial_frame(pycolmap.Image(name=name, camera_id=1, image_id=number), rigid)
    (folder / where).mkdir(parents=True, exist_ok=True)
    (made.write_binary if form == "binary" else made.write_text)(str(folder / where))
    return {image.name: image for image in made.images.values()}


@pytest.mark.parametrize("form", ["binary", "text"])
def test_points_of_the_mesh_are_where_colmap_puts_them_in_its_world(folder, form):
    images = colmap(folder, form=form)
    world_from_object = {"scale": 2.5, "rotation": TURN.tolist(), "translation": [0.3, -0.2, 0.5]}
    external = read_dataset(
        write(folder, {"colmap": "sparse/0", "world_from_object": {"chair": world_from_object}})
    ).external
    in_world = np.array([2.5 * TURN @ point + [0.3, -0.2, 0.5] for point in POINTS])
    for name in PHOTOS:
        assert np.allclose(
            seen(external[name], POINTS), [images[f"{name}.png"].project_point(p) for p in in_world], atol=1e-9
        )
        assert external[name].source == "colmap"


def test_a_mesh_in_the_worlds_frame_gets_the_models_pose_exactly(folder):
    images = colmap(folder)
    external = read_dataset(write(folder, {"colmap": "sparse/0", "world_from_object": {"chair": {}}})).external
    rigid = images["attic.png"].cam_from_world()
    assert np.allclose(external["attic"].poses["chair"].rotation, rigid.rotation.matrix(), atol=1e-14)
    assert np.allclose(external["attic"].poses["chair"].translation, rigid.translation, atol=1e-14)
    assert external["attic"].focal_px == 300.0 and external["attic"].principal_point == (104.0, 71.0)


def test_without_world_from_object_only_the_camera_is_known(folder):
    colmap(folder)
    external = read_dataset(write(folder, {"colmap": "sparse/0"})).external
    assert external["hall"].poses == {} and external["hall"].focal_px == 300.0


def test_lights_are_fixed_to_the_models_world_where_asked_for(folder):
    images = colmap(folder)
    plain = read_dataset(write(folder, {"colmap": "sparse/0"}))
    assert all(photo.world_from_camera is None for photo in plain.spec.photos)
    dataset = read_dataset(write(folder, {"colmap": "sparse/0", "world_from_camera": True}))
    facts = dataset_slice(dataset, "light", "hall").facts
    toward = images["hall.png"].viewing_direction()  # of the world
    assert np.allclose(np.array(facts["world_from_camera"]) @ [0, 0, 1], toward)
    own = read_dataset(
        write(folder, {"colmap": "sparse/0", "world_from_camera": True}, photo={"world_from_camera": TURN.tolist()})
    )
    assert np.allclose(own.spec.photos[0].world_from_camera, TURN)


def test_a_light_of_photos_of_which_one_is_not_in_the_model_is_refused(folder):
    colmap(folder, names=("hall.png",))
    write(folder, {"colmap": "sparse/0", "world_from_camera": True}, photo={"illumination": "attic"})
    with pytest.raises(InputError, match="only one of") as caught:
        read_dataset(folder)
    assert caught.value.key == "photos[1].world_from_camera"


@pytest.mark.parametrize(
    "names, found",
    [
        (("photos/hall.png", "other/hall.png"), "photos/hall.png"),
        (("other/hall.png", "hall.jpg"), "other/hall.png"),
        (("b/hall.JPG", "attic.png"), "b/hall.JPG"),
    ],
)
def test_a_photo_is_found_by_path_then_file_name_then_that_without_suffix(folder, names, found):
    images = colmap(folder, names)
    external = read_dataset(write(folder, {"colmap": "sparse/0", "world_from_object": {"chair": {}}})).external["hall"]
    assert np.allclose(external.poses["chair"].rotation, images[found].cam_from_world().rotation.matrix())


def test_what_follows_a_dot_is_no_suffix_unless_of_an_image(folder):
    (folder / "photos/r_0.5.png").write_text("")
    transforms(folder, [frame("train/r_0.5", np.eye(3), (0, 0, 5)), frame("train/r_0", np.eye(3), (0, 0, 6))])
    external = read_dataset(
        write(folder, {"transforms": "transforms.json"}, photo={"image": "photos/r_0.5.png"})
    ).external
    assert set(external) == {"hall"}


def test_a_photo_that_could_be_several_images_is_refused_until_it_is_said_which(folder):
    images = colmap(folder, names=("x/hall.png", "y/hall.png"))
    with pytest.raises(InputError, match="could be 'x/hall.png', 'y/hall.png'") as caught:
        read_dataset(write(folder, {"colmap": "sparse/0"}))
    assert caught.value.key == "cameras.images.hall"
    cameras = {
        "colmap": "sparse/0",
        "images": {"hall": "y/hall.png", "attic": "x/hall.png"},
        "world_from_object": {"chair": {}},
    }
    external = read_dataset(write(folder, cameras)).external
    assert np.allclose(
        external["hall"].poses["chair"].rotation, images["y/hall.png"].cam_from_world().rotation.matrix()
    )


def test_a_photo_that_is_not_in_the_model_is_warned_of_and_searched(folder, caplog):
    colmap(folder, names=("hall.png",))
    with caplog.at_level(logging.WARNING):
        dataset = read_dataset(write(folder, {"colmap": "sparse/0"}))
    assert (
        set(dataset.external) == {"hall"}
        and "no image of photo 'attic'" in caplog.text
        and "cameras.images" in caplog.text
    )
    assert dataset_slice(dataset, "objects", "attic").facts["external"] is None


def test_an_image_without_a_pose_is_not_in_the_model(folder):
    colmap(folder)
    model = pycolmap.Reconstruction(str(folder / "sparse/0"))
    model.deregister_frame(next(image.frame_id for image in model.images.values() if image.name == "attic.png"))
    model.write_binary(str(folder / "sparse/0"))
    assert set(read_dataset(write(folder, {"colmap": "sparse/0"})).external) == {"hall"}


def test_keypoints_go_before_the_sources_pose(folder):
    colmap(folder)
    corners = ([0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1])
    keypoints = [{"pixel": [10.0 * k, 5.0 * k * k], "point": point} for k, point in enumerate(corners)]
    objects = ({"name": "chair", "mesh": "chair", "keypoints": keypoints}, {"name": "other", "mesh": "chair"})
    cameras = {"colmap": "sparse/0", "world_from_object": {"chair": {}, "other": {}}}
    assert set(read_dataset(write(folder, cameras, objects)).external["hall"].poses) == {"other"}


def test_what_dataset_yaml_gives_for_a_photo_wins(folder):
    colmap(folder, model="SIMPLE_RADIAL", params=(300.0, 104.0, 71.0, -0.3))
    cameras = {"colmap": "sparse/0", "world_from_object": {"chair": {}}}
    given = {"rotation": TURN.tolist(), "translation": [0, 0, 3]}
    own = {
        "camera": {"focal_px": 99.0, "principal_point": [100, 75]},
        "objects": [{"name": "chair", "mesh": "chair", "pose": given}],
    }
    dataset = read_dataset(write(folder, cameras, names=("hall",), photo=own))  # its lens is not even looked at
    assert dataset.external["hall"].poses == {} and dataset.external["hall"].focal_px == 99.0


def test_a_change_of_one_pose_changes_the_slice_of_that_photo_only(folder):
    write(folder, {"transforms": "transforms.json", "world_from_object": {"chair": {}}})
    frames = [frame("hall.png", np.eye(3), (0, 0, 5)), frame("attic.png", np.eye(3), (0, 0, 5))]
    before = read_dataset(transforms(folder, frames))
    frames[1] = frame("attic.png", np.eye(3), (0, 0, 6))
    after = read_dataset(transforms(folder, frames))
    differ = {
        (name, photo)
        for name in ("photo", "objects", "light")
        for photo in PHOTOS
        if dataset_slice(before, name, photo) != dataset_slice(after, name, photo)
    }
    assert differ == {("objects", "attic")}


# ---- lenses --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "model, params, words",
    [
        ("SIMPLE_RADIAL", (300.0, 100.0, 75.0, -0.1), ["distorts", "image_undistorter"]),
        ("OPENCV_FISHEYE", (60.0, 60.0, 100.0, 75.0, 0.1, 0.0, 0.0, 0.0), ["distorts", "image_undistorter"]),
        ("PINHOLE", (300.0, 310.0, 100.0, 75.0), ["not square", "SIMPLE_PINHOLE"]),
        ("SIMPLE_RADIAL", (300.0, 100.0, 75.0, -8.0), ["no ray", "image_undistorter"]),
    ],
)
def test_a_camera_that_is_no_pinhole_of_one_focal_length_is_refused(folder, model, params, words):
    colmap(folder, model=model, params=params)
    with pytest.raises(InputError) as caught:
        read_dataset(write(folder, {"colmap": "sparse/0"}))
    assert all(word in str(caught.value) for word in words) and caught.value.key == "cameras.colmap: hall.png"


@pytest.mark.parametrize(
    "model, params", [("PINHOLE", (300.0, 301.0, 100.0, 75.0)), ("SIMPLE_RADIAL", (300.0, 100.0, 75.0, 0.01))]
)
def test_less_than_half_a_pixel_does_not_matter_and_stays_so(folder, model, params):
    """Nowhere in the image does the pinhole that is taken differ from the camera by more."""
    colmap(folder, model=model, params=params)
    external = read_dataset(write(folder, {"colmap": "sparse/0"})).external["hall"]
    true = pycolmap.Camera(model=model, width=SIZE[0], height=SIZE[1], params=params)
    corners = np.array([[x, y] for x in np.linspace(0, 200, 9) for y in np.linspace(0, 150, 9)])
    rays = np.column_stack([true.cam_from_img(corners), np.ones(len(corners))])
    off = np.linalg.norm(Camera(*SIZE, external.focal_px, external.principal_point).project(rays) - corners, axis=1)
    assert 0.05 < off.max() <= 0.5


# ---- transforms.json -----------------------------------------------------------------------------------------

LENS = {"fl_x": 300.0, "cx": 104.0, "cy": 71.0, "w": 200, "h": 150}
FROM_X = np.column_stack([(0, 0, -1), (0, 1, 0), (1, 0, 0)])  # looks along −x, y up: its right is −z, its back +x


def frame(path, rotation, centre, **lens):
    return {
        "file_path": path,
        "transform_matrix": [*([*row, c] for row, c in zip(np.array(rotation).tolist(), centre)), [0, 0, 0, 1]],
        **lens,
    }


def transforms(folder, frames, lens=LENS):
    (folder / "transforms.json").write_text(json.dumps({**lens, "frames": frames}))
    return folder


def test_what_is_right_and_up_of_an_opengl_camera_is_right_and_up_in_the_photo(folder):
    """5 away, 1 to the right and 2 up: 300 · 1/5 px to the right of the principal point and 300 · 2/5 px above it."""
    write(folder, {"transforms": "transforms.json", "world_from_object": {"chair": {}}})
    transforms(folder, [frame("./images/hall", np.eye(3), (0, 0, 5)), frame("images/attic.jpg", FROM_X, (5, 0, 0))])
    external = read_dataset(folder).external
    expected = [[104 + 60, 71 - 120]]
    assert np.allclose(seen(external["hall"], np.array([[1.0, 2.0, 0.0]])), expected)
    assert np.allclose(seen(external["attic"], np.array([[0.0, 2.0, -1.0]])), expected)
    world = (
        read_dataset(write(folder, {"transforms": "transforms.json", "world_from_camera": True}))
        .spec.photos[1]
        .world_from_camera
    )
    assert np.allclose(np.array(world) @ [0, 0, 1], (-1, 0, 0)) and np.allclose(np.array(world) @ [0, 1, 0], (0, -1, 0))


def test_a_field_of_view_is_a_focal_length_at_any_size(folder):
    """NeRF's own scenes: half a width is seen at half the angle; without w, of whatever width the photo has."""
    angle = 2 * math.atan(100 / 300)
    write(folder, {"transforms": "transforms.json", "world_from_object": {"chair": {}}})
    transforms(
        folder,
        [frame("hall", np.eye(3), (0, 0, 5)), frame("attic", np.eye(3), (0, 0, 5), w=200, h=150)],
        {"camera_angle_x": angle},
    )
    external = read_dataset(folder).external
    for name in PHOTOS:
        assert focal_and_centre(external[name], 200, 150, name) == (pytest.approx(300), (100.0, 75.0))
        assert focal_and_centre(external[name], 400, 300, name) == (pytest.approx(600), (200.0, 150.0))


def test_a_frames_own_lens_goes_before_the_files(folder):
    write(folder, {"transforms": "transforms.json"})
    transforms(folder, [frame("hall", np.eye(3), (0, 0, 5), fl_x=320.0), frame("attic", np.eye(3), (0, 0, 5))])
    external = read_dataset(folder).external
    assert external["hall"].focal_px == 320.0 and external["attic"].focal_px == 300.0


FRAMES = [frame("hall", np.eye(3), (0, 0, 5))]


@pytest.mark.parametrize(
    "lens, frames, key, words",
    [
        ({"w": 200, "h": 150}, FRAMES, "frames[0].fl_x", "camera_angle_x"),
        (LENS | {"fl_x": -3.0}, FRAMES, "frames[0].fl_x", "more than 0"),
        (LENS | {"k1": 0.1}, FRAMES, "transforms.json: frames[0]", "image_undistorter"),
        (LENS | {"camera_model": "EQUIRECTANGULAR"}, FRAMES, "frames[0].camera_model", "OPENCV"),
        (LENS, [frame("hall", 2 * np.eye(3), (0, 0, 5))], "frames[0].transform_matrix", "not a rotation"),
        (LENS, [frame("hall", np.diag([1.0, 1, -1]), (0, 0, 5))], "frames[0].transform_matrix", "reflection"),
        (LENS, [FRAMES[0] | {"transform_matrix": [[1, 0, 0, 0]]}], "frames[0].transform_matrix", "[R | t]"),
        (LENS, [frame("hall", np.eye(3), (0, 0, math.nan))], "frames[0].transform_matrix[2][3]", "finite"),
        (LENS, [{"file_path": "hall"}], "frames[0]", "transform_matrix"),
        (LENS, [frame("cellar", np.eye(3), (0, 0, 5))], "cameras.transforms", "'cellar'"),
    ],
)
def test_wrong_transforms_are_refused_where_they_are_wrong(folder, lens, frames, key, words):
    with pytest.raises(InputError) as caught:
        read_dataset(transforms(write(folder, {"transforms": "transforms.json"}), frames, lens))
    assert caught.value.key == key and words in str(caught.value) and caught.value.cure and caught.value.file


# ---- BOP -----------------------------------------------------------------------------------------------------

K = [300.0, 0, 103.5, 0, 300.0, 70.5, 0, 0, 1.0]
GT = {"obj_id": 5, "cam_R_m2c": NINE, "cam_t_m2c": [0.0, 0.0, 1500.0]}


def bop(folder, cameras=None, poses=None):
    (folder / "scene").mkdir(exist_ok=True)
    (folder / "scene/scene_camera.json").write_text(json.dumps(cameras or {"7": {"cam_K": K, "depth_scale": 1.0}}))
    if poses != {}:
        (folder / "scene/scene_gt.json").write_text(json.dumps(poses or {"7": [GT | {"obj_id": 2}, GT]}))
    return folder


@pytest.mark.parametrize("unit_mm", [1.0, 1000.0])
def test_bop_millimetres_become_the_meshs_units_and_whole_pixels_half_ones(folder, unit_mm):
    """150 mm to the right at 1500 mm: 30 px; the centre of pixel (103.5, 70.5) lies at (104, 71) here."""
    bop(write(folder, {"bop": "scene", "obj_ids": {"chair": 5}, "mesh_unit_mm": unit_mm}, names=("000007",)))
    external = read_dataset(folder).external["seven"]
    assert external.source == "bop" and external.poses["chair"].translation[2] == 1500 / unit_mm
    assert np.allclose(seen(external, np.array([[150.0, 0, 0]]) / unit_mm), [[104 + 30, 71]])


def test_bop_turns_the_model_into_the_camera(folder):
    bop(write(folder, {"bop": "scene", "obj_ids": {"chair": 5}}, names=("000007",)))
    bop(folder, poses={"7": [GT | {"cam_R_m2c": TURN.ravel().tolist()}]})
    x, y, z = TURN @ [100, 50, 20] + [0, 0, 1500]
    assert np.allclose(
        seen(read_dataset(folder).external["seven"], np.array([[100.0, 50, 20]])),
        [[104 + 300 * x / z, 71 + 300 * y / z]],
    )


def test_a_scene_without_poses_or_without_this_one_is_searched(folder, caplog):
    bop(write(folder, {"bop": "scene", "obj_ids": {"chair": 5}}, names=("000007",)), poses={"7": [GT | {"obj_id": 1}]})
    with caplog.at_level(logging.WARNING):
        external = read_dataset(folder).external["seven"]
    assert external.poses == {} and external.focal_px == 300.0 and "no obj_id 5 in image 7" in caplog.text


def test_ids_of_photos_can_be_said(folder):
    bop(write(folder, {"bop": "scene", "images": {"hall": 7}}))
    assert set(read_dataset(folder).external) == {"hall"}


@pytest.mark.parametrize(
    "cameras, poses, key, words",
    [
        ({"7": {"cam_K": [300.0, 5.0, 103.5, 0, 300.0, 70.5, 0, 0, 1.0]}}, None, "7.cam_K", "square axes"),
        ({"7": {"cam_K": [300.0, 0, 103.5, 0, 320.0, 70.5, 0, 0, 1.0]}}, None, "scene_camera.json: 7", "not square"),
        ({"7": {"cam_K": NINE[:4]}}, None, "7.cam_K", "cam_K"),
        ({"first": {"cam_K": K}}, None, "first", "whole numbers"),
        (None, {"7": [GT, GT]}, "cameras.obj_ids.chair", "2 times"),
        (None, {"7": [GT | {"cam_R_m2c": [2.0, *NINE[1:]]}]}, "7[0].cam_R_m2c", "not a rotation"),
    ],
)
def test_wrong_scenes_are_refused_where_they_are_wrong(folder, cameras, poses, key, words):
    bop(write(folder, {"bop": "scene", "obj_ids": {"chair": 5}}, names=("000007",)), cameras, poses)
    with pytest.raises(InputError) as caught:
        read_dataset(folder)
    assert caught.value.key == key and words in str(caught.value) and caught.value.cure and caught.value.file


# ---- the key in dataset.yaml ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "cameras, key, words",
    [
        ({}, "cameras", "names no source"),
        ({"colmap": "sparse/0", "bop": "scene"}, "cameras", "names colmap and bop"),
        ({"colmap": "../elsewhere"}, "cameras.colmap", "outside the dataset"),
        ({"colmap": "nowhere"}, "cameras.colmap", "no folder 'nowhere'"),
        ({"colmap": "photos"}, "cameras.colmap", "sparse/0"),
        ({"transforms": "transfrms.json"}, "cameras.transforms", "did you mean 'transforms.json'"),
        ({"bop": "photos"}, "cameras.bop", "test/000001"),
        ({"colmap": "sparse/0", "images": {"hal": "hall.png"}}, "cameras.images.hal", "did you mean 'hall'"),
        ({"colmap": "sparse/0", "images": {"hall": "hal.png"}}, "cameras.images.hall", "did you mean 'hall.png'"),
        (
            {"colmap": "sparse/0", "world_from_object": {"chai": {}}},
            "cameras.world_from_object.chai",
            "did you mean 'chair'",
        ),
        (
            {"colmap": "sparse/0", "world_from_object": {"chair": {"scale": 0}}},
            "cameras.world_from_object.chair.scale",
            "more than 0",
        ),
        (
            {"colmap": "sparse/0", "world_from_object": {"chair": {"rotation": (2 * np.eye(3)).tolist()}}},
            "cameras.world_from_object.chair.rotation",
            "unit vectors",
        ),
        ({"colmap": "sparse/0", "obj_ids": {"chair": 1}}, "cameras.obj_ids", "world_from_object"),
        ({"bop": "scene", "world_from_camera": True}, "cameras.world_from_camera", "obj_id"),
        ({"bop": "scene", "obj_ids": {"chai": 1}}, "cameras.obj_ids.chai", "did you mean 'chair'"),
    ],
)
def test_a_wrong_key_is_refused_with_a_cure(folder, cameras, key, words):
    colmap(folder)
    bop(transforms(folder, FRAMES))
    with pytest.raises(InputError) as caught:
        read_dataset(write(folder, cameras))
    assert caught.value.key == key and words in str(caught.value) and caught.value.cure
    assert str(caught.value.file).endswith("dataset.yaml")


def test_objects_of_one_photo_share_a_scale(folder):
    colmap(folder)
    objects = [{"name": "chair", "mesh": "chair"}, {"name": "other", "mesh": "chair"}]
    cameras = {"colmap": "sparse/0", "world_from_object": {"chair": {}, "other": {"scale": 2}}}
    with pytest.raises(InputError, match="different scales") as caught:
        read_dataset(write(folder, cameras, objects))
    assert caught.value.key == "cameras.world_from_object"


# ---- photos of another size ----------------------------------------------------------------------------------

EXTERNAL = ExternalCamera("colmap", 300.0, (104.0, 71.0), (200, 150), {})


@pytest.mark.parametrize(
    "width, height, scale", [(200, 150, 1), (400, 300, 2), (100, 75, 0.5), (67, 50, 0.335), (133, 100, 0.665)]
)
def test_the_same_picture_at_another_size_shows_a_point_at_the_same_place_of_it(width, height, scale):
    focal, centre = focal_and_centre(EXTERNAL, width, height, "hall")
    point = np.array([0.2, -0.1, 1.0])
    place = np.array([104 + 300 * 0.2, 71 - 300 * 0.1]) / SIZE * (width, height)
    assert np.allclose(
        Camera(width, height, focal, centre).project(point), place, atol=0 if scale in (1, 2, 0.5) else 0.5
    )


@pytest.mark.parametrize(
    "external, width, height, words",
    [
        (EXTERNAL, 200, 140, "cropped or squeezed"),
        (EXTERNAL, 150, 200, "EXIF orientation"),
        (ExternalCamera("bop", 300.0, (104.0, 71.0), None, {}), 100, 75, "at the size that the source was made of"),
    ],
)
def test_another_picture_is_refused(external, width, height, words):
    with pytest.raises(InputError, match=words) as caught:
        focal_and_centre(external, width, height, "hall")
    assert caught.value.key == f"cameras.{external.source}: hall" and caught.value.cure


def test_thousands_of_photos_find_their_images_in_a_moment():
    photos = [PhotoEntry(name=f"p{i}", image=f"photos/p{i}.png", masks="m.png") for i in range(5000)]
    shots = [Shot(image=f"images/p{i}.jpg", camera=None, size=None, key="") for i in range(5000)]
    began = time.process_time()
    found = matched(DatasetFile(1, [], photos, cameras=CameraSource()), "colmap", shots, None)
    assert [shot.image for shot in found.values()] == [shot.image for shot in shots]
    assert time.process_time() - began < 5


@pytest.mark.parametrize("key", ["scale", "mesh_unit_mm"])
@pytest.mark.parametrize("number", [1e300, 1e-300], ids=["huge", "tiny"])
def test_a_unit_that_no_mesh_has_is_refused(folder, key, number):
    of_source = (
        {"transforms": "t.json", "world_from_object": {"chair": {"scale": number}}},
        {"bop": ".", "mesh_unit_mm": number},
    )
    (folder / "t.json").write_text("{}")
    with pytest.raises(InputError) as caught:
        read_dataset(write(folder, of_source[key != "scale"]))
    assert caught.value.key.endswith(key)
