"""`make photos`: what lies in a folder of photographs, masks, cameras, and the dataset that comes of them."""

import importlib.util
import json
import shutil

import numpy as np
import pycolmap
import pytest
from PIL import Image

from factorlib.dataset.read_dataset import read_dataset
from factorlib.dataset.sources.source_image import SourceImage
from factorlib.generate.solids import SHAPES
from factorlib.geometry.raster import rasterise
from factorlib.onboarding.from_photos import (
    REVOLVED,
    SHAPE,
    cameras_of_folder,
    dataset_from_photos,
    distorted_camera,
    doubtful_masks,
    read_views,
)
from factorlib.onboarding.matte import MatteModel, doubt, foreground, opaque_pixels
from factorlib.onboarding.photo_folder import Cameras, read_photo_folder
from factorlib.scenes.stage_runs import CHECKOUT
from factorlib.shapes.hull import focal_by_hull
from factorlib.shapes.motion import RegisteredCamera
from factorlib.validation import Validation
from tests.faults.sample import put
from tests.images.test_photo import save
from tests.refusal import refusal
from tests.shapes.outlines import CAMERA, looking_from, outline

POSES = [looking_from(elevation, 45 * k) for k, elevation in enumerate([10, 40, -10, 30, 50, 0, 25, -25])]


def cut_out(path, alpha):
    """Write a grey photo that is transparent around a body."""
    picture = np.dstack([np.full((*alpha.shape, 3), 120), 255 * alpha]).astype(np.uint8)
    Image.fromarray(picture).save(put(path, ""))


@pytest.fixture
def cut_outs(tmp_path):
    """A folder with photos of a body in images/, transparent around it, and cameras without a focal length.

    One photo shows more than the body.
    """
    frames = []
    for number, pose in enumerate(POSES):
        alpha = rasterise(SHAPES["blob"](), CAMERA, pose).label > 0
        alpha[:, : 150 * (number == 5)] = True
        cut_out(tmp_path / "capture" / "images" / f"{number}.png", alpha)
        matrix = np.column_stack([pose.rotation.T * [1, -1, -1], -pose.rotation.T @ pose.translation])
        frames.append({"file_path": f"./images/{number}", "transform_matrix": matrix.tolist()})
    (tmp_path / "capture" / "transforms.json").write_text(json.dumps({"frames": frames}))
    return tmp_path


@pytest.mark.long
def test_cut_outs_with_poses_become_a_valid_dataset_with_a_hull_and_a_focal_length_without_a_click(cut_outs):
    steps = []
    missing, notes = dataset_from_photos(
        cut_outs / "mine", cut_outs / "capture", None, None, lambda share, text: steps.append(share)
    )
    dataset = read_dataset(cut_outs / "mine")
    assert missing == [] and Validation(dataset).faults([("photo", None, {}, cut_outs)]) == []
    assert dataset.spec.meshes["thing"].hull and {photo.light for photo in dataset.spec.photos} == {"room"}
    assert dataset.external["3"].focal_px == pytest.approx(CAMERA.focal, rel=0.1)
    assert "mask of 5 in" in notes[-1] and "differs" in notes[-1] and steps == sorted(steps)


@pytest.mark.parametrize("body, revolved", [("vase", True), ("blob", False)])
def test_without_cameras_outlines_tell_whether_the_thing_is_a_body_of_revolution(tmp_path, body, revolved):
    for number in (0, 2):
        cut_out(tmp_path / "photos" / f"{number}.png", rasterise(SHAPES[body](), CAMERA, POSES[number]).label > 0)
    missing, notes = dataset_from_photos(tmp_path / "mine", tmp_path / "photos", None, None, lambda share, text: None)
    assert (SHAPE in missing, REVOLVED in notes) == (not revolved, revolved)
    assert any("each 10 to 20° from the next" in note for note in notes) == (not revolved)
    if revolved:
        dataset = read_dataset(tmp_path / "mine")
        assert dataset.spec.meshes["thing"].lathe and Validation(dataset).faults([("photo", None, {}, tmp_path)]) == []


def test_photos_that_structure_from_motion_does_not_place_are_named_and_left_out(cut_outs, monkeypatch):
    cameras = {name: RegisteredCamera(CAMERA.focal, POSES[int(name)]) for name in "012346"}
    monkeypatch.setattr("factorlib.onboarding.from_photos.cameras_by_motion", lambda photos, report: cameras)
    missing, notes = dataset_from_photos(
        cut_outs / "mine", cut_outs / "capture" / "images", None, None, lambda share, text: None, whole=True
    )
    names = sorted(path.stem for path in (cut_outs / "mine" / "photos").iterdir())
    assert missing == [] and names == list(cameras) and any("place them: 5, 7;" in note for note in notes)
    assert [photo.name for photo in read_dataset(cut_outs / "mine").spec.photos] == names


def brightest(pixels, size):
    """A network that takes the brightest thing of a picture for its foreground."""
    inside = pixels.mean(axis=2) > 0.9 * pixels.max()
    return np.asarray(Image.fromarray(inside).resize(size[::-1])).astype(float), 1.0


def test_a_mask_of_another_thing_is_found_again_where_the_other_photos_show_the_body(cut_outs, monkeypatch):
    """A white square in the corner of two photos is brighter than the body, which is grey."""
    bodies = {}
    for file in (cut_outs / "capture" / "images").iterdir():
        alpha = rasterise(SHAPES["blob"](), CAMERA, POSES[int(file.stem)]).label > 0
        grey = np.where(alpha, 120, 20)
        grey[:25, :25] = 250 if file.stem in "25" else 20
        Image.fromarray(np.dstack([grey] * 3).astype(np.uint8)).save(file)
        bodies[file.stem] = alpha
    cameras = cut_outs / "capture" / "transforms.json"
    lens = {"fl_x": CAMERA.focal, "w": CAMERA.width, "h": CAMERA.height}
    cameras.write_text(json.dumps(json.loads(cameras.read_text()) | lens))
    monkeypatch.setattr("factorlib.onboarding.from_photos.MatteModel", lambda path: brightest)
    _, notes = dataset_from_photos(
        cut_outs / "mine", cut_outs / "capture", None, None, lambda share, text: None, whole=True
    )
    for name, alpha in bodies.items():
        mask = np.asarray(Image.open(cut_outs / "mine" / "masks" / f"{name}.png")) > 0
        assert (mask & alpha).sum() > 0.98 * (mask | alpha).sum(), name
    assert not any("differs" in note for note in notes)


def test_parts_are_not_proposed_where_a_photo_has_no_camera(cut_outs):
    """Its pixels would all be the first part's."""
    file = cut_outs / "capture" / "transforms.json"
    content = json.loads(file.read_text())
    lens = {"fl_x": CAMERA.focal, "w": CAMERA.width, "h": CAMERA.height}
    del content["frames"][-1]["transform_matrix"]
    file.write_text(json.dumps(content | lens))
    _, notes = dataset_from_photos(cut_outs / "mine", cut_outs / "capture", None, None, lambda share, text: None)
    assert "parts by colour are not proposed, because photos have no camera: 7" in notes


NFC, NFD = "k\u00fcche", "ku\u0308che"
RIG = [
    f"{kind}/{side}/7.{suffix}" for kind, suffix in (("images", "jpg"), ("masks", "png")) for side in ("front", "back")
]
RIG_MASKS = {f"images/{side}/7.jpg": f"masks/{side}/7.png" for side in ("front", "back")}
ONE = ["images/7.jpg", "images_2/7.jpg", "other/8.jpg"]
POLYCAM = [
    f"keyframes/{kind}/7.{suffix}" for kind, suffix in (("images", "jpg"), ("depth", "png"), ("confidence", "png"))
]
FOLDERS = [  # files, masks of the frames of transforms.json, the mask of each photo or the words of an error
    *(([*ONE, mask], {"images/7.jpg": "alpha/m.png" if "alpha" in mask else None}, {"images/7.jpg": mask}) for mask in
      ("7_mask.png", "7.jpg.png", "masks/7.png", "masks/7.jpg", "masks/7.bmp", "7-Mask.webp", "alpha/m.png", "sam_masks/7.png")),
    ([*ONE, "masks/7.png", "masks_2/7.png"], {"images\\7.jpg": "masks\\7.png"}, {"images/7.jpg": "masks/7.png"}),
    ([*ONE, "msk/7.png"], {"./images\\7.jpg": "msk\\7.png"}, {"images/7.jpg": "msk/7.png"}),
    ([*ONE, "depths/7.png"], {"C:\\scan\\images\\7.jpg": None, "images/9.jpg": None}, {"images/7.jpg": None}),
    (ONE, {"images/7.jpg": "masks/7.png"}, "mask_path of images/7.jpg: there is no picture 'masks/7.png'"),
    (["7.jpg", "7.png"], {"7.jpg": None, "7.png": None}, {"7.jpg": None, "7.png": None}),
    (RIG, None, RIG_MASKS),
    (RIG, RIG_MASKS, RIG_MASKS),
    (RIG, dict.fromkeys(RIG_MASKS), RIG_MASKS),
    (RIG[:3], dict.fromkeys(RIG_MASKS), RIG_MASKS | {"images/back/7.jpg": None}),
    (["front/images/7.jpg", "back/images/7.jpg", "front/mask/7.jpg.png"], None, {"front/images/7.jpg": "front/mask/7.jpg.png", "back/images/7.jpg": None}),
    ([*RIG[:2], "masks/7.png"], None, "not clear whether it is the mask of images/(front|back)/7.jpg"),
    (["7.jpg", "masks/7.png", "sam_masks/7.png"], None, "not clear whether it is the mask of 7.jpg"),
    (["images/7.jpg", "images_4/7.jpg", "masks/7.png", "masks_4/7.png"], None, {"images/7.jpg": "masks/7.png"}),
    ([*POLYCAM, "thumbnail.jpg"], None, {POLYCAM[0]: None}),
    ([*POLYCAM, "keyframes/corrected_images/7.jpg"], None, {"keyframes/corrected_images/7.jpg": None}),
    ([f"{NFD}.jpg", f"{NFC}_mask.png"], None, {f"{NFD}.jpg": f"{NFC}_mask.png"}),
    ([f"images/{NFD}.jpg", f"masks/{NFC}.png"], {f"images/{NFC}.jpg": None}, {f"images/{NFD}.jpg": f"masks/{NFC}.png"}),
]  # fmt: skip


@pytest.mark.parametrize("names, frames, expected", FOLDERS)
def test_each_photo_has_its_own_mask_and_neither_masks_nor_copies_nor_depth_are_photos(
    tmp_path, names, frames, expected
):
    files = [put(tmp_path / name, "1") for name in names]
    if frames:
        content = {"frames": [{"file_path": name, "mask_path": mask} for name, mask in frames.items()]}
        files.append(put(tmp_path / "transforms.json", json.dumps(content)))
    if isinstance(expected, str):
        assert refusal(expected, read_photo_folder, tmp_path, files).file
    else:
        images, masks, _ = read_photo_folder(tmp_path, files)
        masks = {str(image.relative_to(tmp_path)): masks.get(image) for image in images}
        assert masks == {image: mask and tmp_path / mask for image, mask in expected.items()}


def test_wrong_cameras_are_named_by_their_own_file_also_where_the_focal_length_is_missing(tmp_path):
    frame = {"file_path": "7.jpg", "transform_matrix": [[0, 0, 0, 0]] * 3}
    file = put(tmp_path / "transforms.json", json.dumps({"frames": [frame]}))
    cameras = Cameras({"transforms": "cameras/transforms.json"}, tmp_path, [file])
    assert refusal("not a rotation", cameras_of_folder, {}, {}, cameras, tmp_path, None).file == file


@pytest.mark.parametrize("top, dtype", [(255, np.uint8), (65535, np.uint16)])
def test_a_mask_beside_a_photo_is_its_labels_or_a_matte_cut_at_half(tmp_path, top, dtype):
    Image.fromarray(np.zeros((2, 4, 3), np.uint8)).save(tmp_path / "a.jpg")
    for values, inside in (([0, 1, 2, 255], [0, 1, 1, 0]), ([0, top // 3, top // 2 + 1, top], [0, 0, 1, 1])):
        Image.fromarray(np.array([values] * 2, dtype)).save(tmp_path / "a_mask.png")
        shutil.rmtree(tmp_path / "masks", ignore_errors=True)
        read_views({"a": tmp_path / "a.jpg"}, {"a": tmp_path / "a_mask.png"}, None, tmp_path, lambda share, text: None)
        assert np.asarray(Image.open(tmp_path / "masks" / "a.png")).tolist() == [inside] * 2


def test_masks_that_cannot_be_read_are_named_in_one_error(tmp_path):
    names = [f"p{number}" for number in range(6)]
    for name in names:
        Image.fromarray(np.zeros((40, 60, 3), np.uint8)).save(tmp_path / f"{name}.jpg")
        values = np.repeat([0, 130, 255], 20).astype(np.uint8)
        Image.fromarray(np.tile(values, (40, 1))).save(tmp_path / f"{name}_mask.jpg")
    images, masks = ({name: tmp_path / f"{name}{end}.jpg" for name in names} for end in ("", "_mask"))
    error = refusal("is of a lossy format", read_views, images, masks, None, tmp_path, lambda share, text: None)
    assert str(error).count("save labels as PNG") == 1 and "(and 5 more: p1_mask.jpg, p2_mask.jpg" in str(error)


def test_a_photo_without_alpha_prints_nothing_and_one_that_hides_nothing_has_none(tmp_path, capfd):
    save(tmp_path / "a.tif", np.ones((2, 4, 3), np.float32))
    save(tmp_path / "b.tif", np.full((2, 4, 4), 65000, np.uint16), ["R", "G", "B", "A"])
    files = tmp_path / "a.tif", tmp_path / "b.tif", CHECKOUT / "data/eames/photos/hall.jpg"
    assert list(map(opaque_pixels, files)) == [None] * 3 and capfd.readouterr() == ("", "")


def test_a_lens_that_two_coefficients_describe_is_a_camera_and_a_fisheye_is_none():
    radial, fisheye = (
        pycolmap.Camera(model=model, width=1000, height=750, params=[400, *params])
        for model, params in (("RADIAL", (500, 375, -0.1, 0.02)), ("OPENCV_FISHEYE", (400, 500, 375, 0.01, 0, 0, 0)))
    )
    camera = distorted_camera(SourceImage("a", radial, (1000, 750), "a"), 1000)["camera"]
    assert [camera["focal_px"], *camera["distortion"]] == pytest.approx([400, -0.1, 0.02], rel=1e-3)
    assert distorted_camera(SourceImage("a", fisheye, (1000, 750), "a"), 1000) == {}


def test_cameras_at_one_place_tell_no_focal_length_and_no_doubt():
    same = [outline(SHAPES["blob"](), POSES[0], True)] * 3
    assert doubtful_masks({}, same) == []
    refusal("no focal length", focal_by_hull, lambda focal: same, 300)


def test_without_the_network_the_error_has_the_command(monkeypatch):
    monkeypatch.setattr("factorlib.onboarding.matte.find_spec", lambda name: None)
    assert "make setup EXTRAS=masks" in refusal("not installed", MatteModel).cure


def test_specks_are_no_foreground_and_a_blurred_border_is_in_doubt():
    x, y = np.meshgrid(np.arange(90.0), np.arange(90.0))
    sharp, soft = (1 / (1 + np.exp((np.hypot(x - 40, y - 40) - 25) / width)) for width in (0.3, 4.0))
    speckled = np.where((x > 84) & (y > 84), 1.0, sharp)
    assert np.array_equal(foreground(speckled), sharp > 0.5) and doubt(sharp) < 2 < 8 < doubt(soft)


@pytest.mark.skipif(not importlib.util.find_spec("rembg"), reason="make setup EXTRAS=masks")
def test_the_network_masks_a_chair():
    pixels, label = (np.asarray(Image.open(f"data/eames/{name}")) for name in ("photos/garden.jpg", "masks/garden.png"))
    chair, mask = (label > 0)[label < 255], foreground(MatteModel()(pixels, label.shape)[0])[label < 255]
    assert (mask & chair).sum() > 0.95 * (mask | chair).sum()
