"""Cameras from elsewhere: a known point lands where the source's own tool puts it, and what cannot be used is refused."""

import json
import math
import re

import msgspec
import numpy as np
import pycolmap
import pytest
import yaml
from scipy.spatial.transform import Rotation

from factorlib.align.input_checks import camera_of_photo, convert_intrinsics
from factorlib.dataset.read_dataset import read_dataset
from factorlib.dataset.schema import ExternalCamera, ObjectsSlice
from factorlib.dataset.slices import dataset_slice
from factorlib.dataset.sources.external_cameras import upright_turn
from factorlib.geometry.camera import Camera, Pose
from factorlib.results.photos import PhotoFacts
from tests.faults.sample import put
from tests.refusal import refusal

SIZE = 200, 150
POINTS = np.array([[0.3, -0.2, 0.1], [-0.4, 0.1, 0.6], [0.0, 0.5, -0.3]])
TURN = Rotation.from_rotvec([0.4, -0.9, 0.3]).as_matrix()
NINE = [1.0, 0, 0, 0, 1.0, 0, 0, 0, 1.0]
EYE = np.eye(3)
PHOTOS = ("hall", "attic")
CHAIR = {"name": "chair", "mesh": "chair"}
PLACED = {"colmap": "sparse/0", "world_from_object": {"chair": {}}}
OF_TRANSFORMS = {"transforms": "transforms.json", "world_from_object": {"chair": {}}}
OF_BOP = {"bop": "scene", "obj_ids": {"chair": 5}}


@pytest.fixture
def folder(tmp_path):
    for name in ("photos/hall.png", "photos/attic.png", "photos/000007.png", "mask.png", "chair.ply"):
        put(tmp_path / "set" / name, "")
    return tmp_path / "set"


def read(folder, cameras, objects=(CHAIR,), names=PHOTOS, photo=None):
    """A dataset of photos with a source of cameras; `photo` is laid over the first."""
    photos = [{"name": name.replace("000007", "seven").replace(" ", "_"), "image": f"photos/{name}.png", "masks": "mask.png",
               "objects": list(objects)} for name in names]  # fmt: skip
    photos[0] |= photo or {}
    meshes = {"chair": {"file": "chair.ply", "material": "red"}}
    spec = {"format": 1, "materials": ["red"], "meshes": meshes, "photos": photos, "cameras": cameras}
    return read_dataset(put(folder / "dataset.yaml", yaml.safe_dump(spec)).parent)


def refused(folder, cameras, key, words, **options):
    error = refusal(re.escape(words), read, folder, cameras, **options)
    assert error.key == key and error.file
    return error


def pixels(external, points, name="chair"):
    """Where the photo shows points of the mesh, by the external camera."""
    focal, centre = convert_intrinsics(external, *SIZE, "hall")
    pose = external.poses[name]
    return Camera(*SIZE, focal, centre).project(Pose(np.array(pose.rotation), np.array(pose.translation)).apply(points))


def colmap(folder, names=("hall.png", "attic.png"), form="binary", model="SIMPLE_PINHOLE", params=(300.0, 104.0, 71.0)):
    """A model of a camera that stands at different places; its images are returned by name."""
    made = pycolmap.Reconstruction()
    made.add_camera_with_trivial_rig(pycolmap.Camera(model=model, width=200, height=150, params=params, camera_id=1))
    for number, name in enumerate(names, start=1):
        turn = pycolmap.Rotation3d(Rotation.from_rotvec([0.1, number, -0.2]).as_matrix())
        image = pycolmap.Image(name=name, camera_id=1, image_id=number)
        made.add_image_with_trivial_frame(image, pycolmap.Rigid3d(turn, [0.2, -0.1, 4.0 + number]))
    (folder / "sparse/0").mkdir(parents=True, exist_ok=True)
    (made.write_binary if form == "binary" else made.write_text)(str(folder / "sparse/0"))
    return {image.name: image for image in made.images.values()}


def is_pose_of(external, image):
    pose = external.poses["chair"]
    return np.allclose(np.column_stack([pose.rotation, pose.translation]), image.cam_from_world().matrix(), atol=1e-14)


@pytest.mark.parametrize("form", ["binary", "text"])
def test_points_of_the_mesh_are_where_colmap_puts_them_in_its_world(folder, form):
    images = colmap(folder, form=form)
    place = {"scale": 2.5, "rotation": TURN.tolist(), "translation": [0.3, -0.2, 0.5]}
    external = read(folder, {"colmap": "sparse/0", "world_from_object": {"chair": place}}).external
    in_world = 2.5 * POINTS @ TURN.T + [0.3, -0.2, 0.5]
    for name in PHOTOS:
        expected = [images[f"{name}.png"].project_point(p) for p in in_world]
        assert np.allclose(pixels(external[name], POINTS), expected, atol=1e-9) and external[name].source == "colmap"
    external = read(folder, PLACED).external["attic"]  # in the world's frame: the model's pose exactly
    assert is_pose_of(external, images["attic.png"])
    assert external.focal_px == 300.0 and external.principal_point == (104.0, 71.0)
    without = read(folder, {"colmap": "sparse/0"}).external["hall"]
    assert without.poses == {} and without.focal_px == 300.0


def test_lights_are_fixed_to_the_models_world_where_asked_for(folder):
    images = colmap(folder)
    assert all(photo.world_from_camera is None for photo in read(folder, {"colmap": "sparse/0"}).spec.photos)
    fixed = {"colmap": "sparse/0", "world_from_camera": True}
    facts = dataset_slice(read(folder, fixed), "light", "hall").facts
    turn = upright_turn([image.cam_from_world().inverse().rotation for image in images.values()]).matrix()
    assert np.allclose(np.array(facts["world_from_camera"]) @ [0, 0, 1], turn @ images["hall.png"].viewing_direction())
    own = read(folder, fixed, photo={"world_from_camera": TURN.tolist()})
    origins = {words: dataset.up for words, dataset in {
        "common horizon": read(folder, fixed),
        "cameras.up: z": read(folder, fixed | {"up": "z"}),
        "dataset.yaml gives": own,
        "fixed to its camera": read(folder, {"colmap": "sparse/0"}),
    }.items()}  # fmt: skip
    assert all(words in up for words, up in origins.items()) and len(set(origins.values())) == 4
    assert dataset_slice(own, "set").facts["up"] == own.up
    assert np.allclose(own.spec.photos[0].world_from_camera, TURN)
    matrix = images["attic.png"].cam_from_world().inverse().rotation.matrix()
    assert np.allclose(own.spec.photos[1].world_from_camera, matrix)  # beside one that stands there, none is turned
    colmap(folder, names=("hall.png",))
    refused(folder, fixed, "photos[1].world_from_camera", "only one of", photo={"illumination": "attic"})


def test_a_photo_is_matched_by_path_then_file_name_then_that_without_suffix_or_as_it_is_said(folder):
    for names, match in (
        (("photos/hall.png", "other/hall.png"), "photos/hall.png"),
        (("other/hall.png", "hall.jpg"), "other/hall.png"),
        (("b/hall.JPG", "attic.png"), "b/hall.JPG"),
    ):
        images = colmap(folder, names)
        assert is_pose_of(read(folder, PLACED).external["hall"], images[match])
    images = colmap(folder, names=("x/hall.png", "y/hall.png"))
    refused(folder, PLACED, "cameras.images.hall", "several images of the source: 'x/hall.png', 'y/hall.png'")
    external = read(folder, PLACED | {"images": {"hall": "y/hall.png", "attic": "x/hall.png"}}).external
    assert is_pose_of(external["hall"], images["y/hall.png"])
    (folder / "photos/r_0.5.png").write_text("")  # what follows this dot is no suffix
    transforms(folder, [frame("train/r_0.5", EYE, (0, 0, 5)), frame("train/r_0", EYE, (0, 0, 6))])
    assert set(read(folder, OF_TRANSFORMS, photo={"image": "photos/r_0.5.png"}).external) == {"hall"}


def test_a_camera_that_is_no_pinhole_of_one_focal_length_is_refused_unless_it_is_so_within_half_a_pixel(folder):
    for model, params, fault, cure in (
        ("SIMPLE_RADIAL", (300.0, 100.0, 75.0, -0.1), "distorts", "image_undistorter"),
        ("OPENCV_FISHEYE", (60.0, 60.0, 100.0, 75.0, 0.1, 0.0, 0.0, 0.0), "distorts", "image_undistorter"),
        ("PINHOLE", (300.0, 310.0, 100.0, 75.0), "not square", "SIMPLE_PINHOLE"),
        ("SIMPLE_RADIAL", (300.0, 100.0, 75.0, -8.0), "no ray", "image_undistorter"),
    ):
        colmap(folder, model=model, params=params)
        assert cure in refused(folder, {"colmap": "sparse/0"}, "cameras.colmap: hall.png", fault).cure
    for model, params in (("PINHOLE", (300.0, 301.0, 100.0, 75.0)), ("SIMPLE_RADIAL", (300.0, 100.0, 75.0, 0.01))):
        colmap(folder, model=model, params=params)
        external = read(folder, {"colmap": "sparse/0"}).external["hall"]
        true = pycolmap.Camera(model=model, width=SIZE[0], height=SIZE[1], params=params)
        corners = np.array([[x, y] for x in np.linspace(0, 200, 9) for y in np.linspace(0, 150, 9)])
        rays = np.column_stack([true.cam_from_img(corners), np.ones(len(corners))])
        ours = Camera(*SIZE, external.focal_px, external.principal_point).project(rays)
        assert 0.05 < np.linalg.norm(ours - corners, axis=1).max() <= 0.5


LENS = {"fl_x": 300.0, "cx": 104.0, "cy": 71.0, "w": 200, "h": 150}
FROM_X = np.column_stack([(0, 0, -1), (0, 1, 0), (1, 0, 0)])  # looks along −x, y up: its right is −z, its back +x


def frame(path, rotation, centre, **lens):
    rows = np.column_stack([rotation, centre]).tolist()
    return {"file_path": path, "transform_matrix": [*rows, [0, 0, 0, 1]], **lens}


def transforms(folder, frames, lens=LENS):
    return put(folder / "transforms.json", json.dumps({**lens, "frames": frames})).parent


def test_what_is_right_and_up_of_an_opengl_camera_is_right_and_up_in_the_photo(folder):
    """5 away, 1 to the right and 2 up: 300 · 1/5 px to the right of the principal point and 300 · 2/5 px above it."""
    transforms(folder, [frame("./images/hall", EYE, (0, 0, 5)), frame("images/attic.jpg", FROM_X, (5, 0, 0))])
    external = read(folder, OF_TRANSFORMS).external
    for name, point in (("hall", [1.0, 2.0, 0.0]), ("attic", [0.0, 2.0, -1.0])):
        assert np.allclose(pixels(external[name], np.array([point])), [[104 + 60, 71 - 120]])
    world = np.array(read(folder, OF_TRANSFORMS | {"world_from_camera": True}).spec.photos[1].world_from_camera)
    assert np.allclose(world @ [0, 0, 1], (-1, 0, 0)) and np.allclose(world @ [0, 1, 0], (0, 1, 0))


@pytest.mark.parametrize("azimuths", [360.0, 20.0])
def test_the_world_stands_upright_by_the_horizon_of_photos_that_look_down_and_are_held_askew(azimuths):
    rng = np.random.default_rng(0)
    tilted = Rotation.from_rotvec([0.7, -0.3, 1.9]).as_matrix()  # world from one that stands upright
    rotations = []
    for angle in np.linspace(0, azimuths, 12, endpoint=False):
        roll, down = np.radians([2 * rng.normal(), rng.uniform(5, 40)])
        level = Rotation.from_euler("YXZ", [np.radians(angle), -down, roll]).as_matrix()
        rotations.append(pycolmap.Rotation3d(tilted @ level))
    upright = tilted @ [0, -1, 0]
    error = np.degrees(np.arccos(upright_turn(rotations).matrix() @ upright @ [0, -1, 0]))
    assert error < (2 if azimuths == 360 else 15)  # the mean of the photos is 22° off


@pytest.mark.parametrize("up", ["x", "y", "z", "-x", "-y", "-z"])
def test_the_axis_that_is_named_points_up(up):
    axis = np.eye(3)["xyz".index(up[-1])] * (-1 if up[0] == "-" else 1)
    turn = upright_turn([], up).matrix()
    assert np.allclose(turn @ axis, [0, -1, 0]) and np.linalg.det(turn) == pytest.approx(1)
    assert np.allclose(turn.T @ turn, np.eye(3))


def test_a_field_of_view_is_a_focal_length_at_any_size_and_a_frames_own_lens_goes_before_the_files(folder):
    """NeRF's own scenes: half a width lies at half the angle; without w, of whatever width the photo has."""
    frames = [frame("hall", EYE, (0, 0, 5)), frame("attic", EYE, (0, 0, 5), w=200, h=150)]
    external = read(transforms(folder, frames, {"camera_angle_x": 2 * math.atan(100 / 300)}), OF_TRANSFORMS).external
    for name in PHOTOS:
        assert convert_intrinsics(external[name], 200, 150, name) == (pytest.approx(300), (100.0, 75.0))
        assert convert_intrinsics(external[name], 400, 300, name) == (pytest.approx(600), (200.0, 150.0))
    transforms(folder, [frame("hall", EYE, (0, 0, 5), fl_x=320.0), frame("attic", EYE, (0, 0, 5))])
    external = read(folder, OF_TRANSFORMS).external
    assert [external[name].focal_px for name in PHOTOS] == [320.0, 300.0]


def test_without_a_focal_length_that_of_the_photo_or_its_exif_is_taken_and_else_none(folder):
    transforms(folder, [frame(name, EYE, (0, 0, 5)) for name in PHOTOS], {"w": 200, "h": 150, "cx": 104, "cy": 71})
    dataset = read(folder, OF_TRANSFORMS, photo={"camera": {"focal_px": 700.0}})
    for name, focal, source in (("hall", 700.0, "dataset"), ("attic", 250.0, "exif"), ("attic", None, None)):
        facts = PhotoFacts(200, 150, 1, (200, 150), focal, source, "srgb", None, "a", {}, 0.0)
        slice_ = msgspec.convert(dataset_slice(dataset, "objects", name).facts, ObjectsSlice)
        camera, known = camera_of_photo(slice_, facts, name)
        assert (known.focal, known.source) == (focal, source) and camera.centre == (104, 71)
        assert slice_.external.poses["chair"].translation == (0, 0, 5)


FRAMES = [frame("hall", EYE, (0, 0, 5))]


@pytest.mark.parametrize("lens, frames, key, words", [
    (LENS | {"camera_model": "OPENCV_FISHEYE"}, FRAMES, "transforms.json: frames[0]", "image_undistorter"),
    (LENS | {"is_fisheye": True}, FRAMES, "transforms.json: frames[0]", "image_undistorter"),
    (LENS | {"k1": 0.1}, FRAMES, "transforms.json: frames[0]", "image_undistorter"),
    (LENS | {"camera_model": "EQUIRECTANGULAR"}, FRAMES, "frames[0].camera_model", "OPENCV"),
    (LENS, [frame("hall", 2 * EYE, (0, 0, 5))], "frames[0].transform_matrix", "not a rotation"),
    (LENS, [frame("hall", np.diag([1.0, 1, -1]), (0, 0, 5))], "frames[0].transform_matrix", "reflection"),
    (LENS, [FRAMES[0] | {"transform_matrix": [[1, 0, 0, 0]]}], "frames[0].transform_matrix", "[R | t]"),
    (LENS, [{"file_path": "hall"}], "frames", "none has a transform_matrix"),
    (LENS, [frame("cellar", EYE, (0, 0, 5))], "cameras.transforms", "'cellar'"),
])  # fmt: skip
def test_wrong_transforms_are_refused_where_they_are_wrong(folder, lens, frames, key, words):
    refused(transforms(folder, frames, lens), OF_TRANSFORMS, key, words)


def test_a_frame_without_a_matrix_is_a_photo_without_a_camera(folder, caplog):
    frames = [*FRAMES, {"file_path": "attic", "transform_matrix": None}, frame("no\\such", EYE, (0, 0, 5))]
    assert set(read(transforms(folder, frames), OF_TRANSFORMS).external) == {"hall"}
    assert "frames[1]: attic has no transform_matrix" in caplog.text and "no image of photo" not in caplog.text


HALL, TRACKS = "1 .6 .8 0 0 0 0 5 1 hall.png\n", "1.5 2 -1 3 4e1 17\n"
ATTIC = HALL.replace("hall", "my house/attic 1")


@pytest.mark.parametrize("text, words", [
    (HALL + "\n" + ATTIC + "\n", None), (HALL + TRACKS + ATTIC + TRACKS, None), (HALL + ATTIC, None),
    (HALL + ATTIC + TRACKS, None), (f"# images\n{HALL}# points\n{TRACKS}\n# more\n{ATTIC}", None),
    (HALL.replace("\n", "\r\n") + "\r\n" + ATTIC, None), (HALL + TRACKS + TRACKS, "line 3: '1.5 2 -1"),
    (HALL + HALL.replace("hall.png", ""), "line 2: '1 .6 .8 0 0 0 0 5 1' has 9 words"), (TRACKS + HALL, "line 1"),
])  # fmt: skip
def test_images_txt_is_read_with_lines_of_points_or_without_and_refused_by_line(folder, text, words):
    colmap(folder, form="text")
    (folder / "sparse/0/images.txt").write_text(text)
    (folder / "photos/attic 1.png").write_text("")
    source = {"colmap": "sparse/0"}
    if words:
        refused(folder, source, "cameras.colmap", words)
    else:
        assert len(read(folder, source, names=("hall", "attic 1")).external) == 2


K = [300.0, 0, 103.5, 0, 300.0, 70.5, 0, 0, 1.0]
GT = {"obj_id": 5, "cam_R_m2c": NINE, "cam_t_m2c": [0.0, 0.0, 1500.0]}


def bop(folder, cameras=None, poses=None):
    put(folder / "scene/scene_camera.json", json.dumps(cameras or {"7": {"cam_K": K, "depth_scale": 1.0}}))
    put(folder / "scene/scene_gt.json", json.dumps(poses or {"7": [GT | {"obj_id": 2}, GT]}))
    return folder


@pytest.mark.parametrize("unit_mm", [1.0, 1000.0])
def test_bop_millimetres_become_the_meshs_units_and_whole_pixels_half_ones(folder, unit_mm):
    """Where a turned model's point lands; the centre of pixel (103.5, 70.5) lies at (104, 71) here."""
    bop(folder, poses={"7": [GT | {"obj_id": 2}, GT | {"cam_R_m2c": TURN.ravel().tolist()}]})
    external = read(folder, OF_BOP | {"mesh_unit_mm": unit_mm}, names=("000007",)).external["seven"]
    assert external.source == "bop" and external.poses["chair"].translation[2] == 1500 / unit_mm
    x, y, z = TURN @ [100, 50, 20] + [0, 0, 1500]
    place = pixels(external, np.array([[100.0, 50, 20]]) / unit_mm)
    assert np.allclose(place, [[104 + 300 * x / z, 71 + 300 * y / z]])


@pytest.mark.parametrize("cameras, poses, key, words", [
    ({"7": {"cam_K": [300.0, 5.0, 103.5, 0, 300.0, 70.5, 0, 0, 1.0]}}, None, "7.cam_K", "has a skew"),
    ({"7": {"cam_K": [300.0, 0, 103.5, 0, 320.0, 70.5, 0, 0, 1.0]}}, None, "scene_camera.json: 7", "not square"),
    ({"7": {"cam_K": NINE[:4]}}, None, "7.cam_K", "cam_K"),
    (None, {"7": [GT, GT]}, "cameras.obj_ids.chair", "2 times"),
    (None, {"7": [GT | {"cam_R_m2c": [2.0, *NINE[1:]]}]}, "7[0].cam_R_m2c", "not a rotation"),
])  # fmt: skip
def test_wrong_scenes_are_refused_where_they_are_wrong(folder, cameras, poses, key, words):
    refused(bop(folder, cameras, poses), OF_BOP, key, words, names=("000007",))


EXTERNAL = ExternalCamera("colmap", 300.0, (104.0, 71.0), (200, 150), {})


def test_the_same_picture_at_another_size_shows_a_point_at_the_same_place_and_another_is_refused():
    for width, height, off in (200, 150, 0), (400, 300, 0), (100, 75, 0), (67, 50, 0.5), (133, 100, 0.5):
        focal, centre = convert_intrinsics(EXTERNAL, width, height, "hall")
        place = np.array([104 + 300 * 0.2, 71 - 300 * 0.1]) / SIZE * (width, height)
        assert np.allclose(Camera(width, height, focal, centre).project(np.array([0.2, -0.1, 1.0])), place, atol=off)
    for external, width, height, words in (
        (EXTERNAL, 200, 140, "cropped or squeezed"),
        (EXTERNAL, 150, 200, "EXIF orientation"),
        (ExternalCamera("bop", 300.0, (104.0, 71.0), None, {}), 100, 75, "at the size that the source was made of"),
    ):
        error = refusal(words, convert_intrinsics, external, width, height, "hall")
        assert error.key == f"cameras.{external.source}: hall"
