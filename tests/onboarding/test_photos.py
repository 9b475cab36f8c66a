"""`make photos`: what lies in a folder of photographs, masks, cameras, and the dataset that comes of them."""

import importlib.util
import json

import numpy as np
import pytest
from PIL import Image

from factorlib.dataset.read_dataset import read_dataset
from factorlib.generate.solids import SHAPES
from factorlib.geometry.raster import rasterise
from factorlib.onboarding.from_photos import dataset_from_photos
from factorlib.onboarding.matte import MatteModel, doubt, foreground
from factorlib.onboarding.photo_folder import read_photo_folder
from factorlib.validation import Validation
from tests.refusal import refusal
from tests.shapes.outlines import CAMERA, looking_from

POSES = [looking_from(elevation, 45 * k) for k, elevation in enumerate([10, 40, -10, 30, 50, 0, 25, -25])]


@pytest.fixture
def cut_outs(tmp_path):
    """A folder with photos of a body in images/, transparent around it, and cameras without a focal length.

    One photo shows more than the body.
    """
    frames = []
    (tmp_path / "capture" / "images").mkdir(parents=True)
    for number, pose in enumerate(POSES):
        alpha = rasterise(SHAPES["blob"](), CAMERA, pose).label > 0
        alpha[:, : 150 * (number == 5)] = True
        picture = np.dstack([np.full((*alpha.shape, 3), 120), 255 * alpha]).astype(np.uint8)
        Image.fromarray(picture).save(tmp_path / "capture" / "images" / f"{number}.png")
        matrix = np.column_stack([pose.rotation.T * [1, -1, -1], -pose.rotation.T @ pose.translation])
        frames.append({"file_path": f"./images/{number}", "transform_matrix": matrix.tolist()})
    (tmp_path / "capture" / "transforms.json").write_text(json.dumps({"frames": frames}))
    return tmp_path


def test_cut_outs_with_poses_become_a_valid_dataset_with_a_hull_and_a_focal_length_without_a_click(cut_outs):
    steps = []
    arguments = cut_outs / "capture", None, None, lambda share, text: steps.append(share)
    missing, notes = dataset_from_photos(cut_outs / "mine", *arguments)
    dataset = read_dataset(cut_outs / "mine")
    assert missing == [] and Validation(dataset).faults("photo", None, {}, cut_outs) == []
    assert dataset.spec.meshes["thing"].hull and {photo.light for photo in dataset.spec.photos} == {"room"}
    assert dataset.external["3"].focal_px == pytest.approx(CAMERA.focal, rel=0.1)
    assert "mask of 5 in" in notes[-1] and "differs" in notes[-1] and steps == sorted(steps)


@pytest.mark.parametrize("mask", ["7_mask.png", "7.jpg.png", "masks/7.png", "alpha/m.png"])
def test_masks_are_no_photos_and_the_cameras_tell_which_images_are(tmp_path, mask):
    for name in (mask, "images/7.jpg", "images_2/7.jpg", "other/8.jpg"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"1")
    frame = {"file_path": "images/7.jpg", "mask_path": "alpha/m.png"}
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": [frame]}))
    images, masks, cameras = read_photo_folder(tmp_path, sorted(p for p in tmp_path.rglob("*") if p.is_file()))
    assert images == [tmp_path / "images/7.jpg"] and masks == {"7": tmp_path / mask}
    assert cameras.source == {"transforms": "cameras/transforms.json"}


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
