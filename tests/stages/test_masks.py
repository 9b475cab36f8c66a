"""The stage `masks`: what it writes is what the photo and the masks say, and what is refused leaves nothing behind."""

import json
import subprocess
import sys

import msgspec
import numpy as np
import OpenImageIO as oiio
import pytest
from PIL import Image

from factorlib.dataset.schema import ObjectMask, PhotoSlice
from factorlib.images.exr import read_exr, write_rgb_exr
from factorlib.images.photo import box_majority
from factorlib.images.tone import srgb_encode
from factorlib.stage import Inputs
from stages import masks
from tests.refusal import refusal
from tests.stages.made import ran

H, W = 16, 24
MATERIALS = ["red", "wood"]
LABEL = np.zeros((H, W), dtype=np.uint8)
LABEL[1:8, 2:10] = 1
LABEL[9:15, 4:20] = 2
LABEL[0] = 255
RADIANCE = np.random.default_rng(1).uniform(0, 0.8, (H, W, 3)).astype(np.float32)
CHANNELS = {"R", "G", "B", "label", "valid", "left_out", "object", "clipped.R", "clipped.G", "clipped.B"}
SMALLER = {"pixels": 100}  # of the 152 that show a material: factor 2
OWN = [ObjectMask("a", None), ObjectMask("b", "own.png")]
GIVEN = {"image": "photo.exr", "encoding": None, "masks": "mask.png", "labels": MATERIALS, "focal_px": None}
GIVEN["illumination"] = "kitchen"


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "in").mkdir()
    write_rgb_exr(tmp_path / "in" / "photo.exr", RADIANCE)
    Image.fromarray(LABEL).save(tmp_path / "in" / "mask.png")
    Image.fromarray(LABEL == 2).save(tmp_path / "in" / "own.png")
    return tmp_path


def run(folder, params=None, **facts):
    """The channels and the summary the stage writes for a photo `kitchen` with the given facts."""
    photo = PhotoSlice(**GIVEN | {"objects": []} | facts)
    focal = {"dataset.photo": msgspec.to_builtins(photo), "dataset.materials": MATERIALS}
    inputs = Inputs({}, focal, {path.name: path for path in (folder / "in").iterdir()}, "kitchen")
    out = ran(masks, inputs, folder / "out", **params or {})
    assert sorted(path.name for path in out.iterdir()) == ["kitchen.exr", "kitchen.json"]
    return read_exr(out / "kitchen.exr"), json.loads((out / "kitchen.json").read_text())


def test_the_alpha_of_a_cut_out_is_averaged_down_with_it_and_an_opaque_photo_has_none(folder):
    codes = np.dstack([np.full((H, W, 3), 120, np.uint8), np.where(LABEL > 0, 255, 40).astype(np.uint8)])
    Image.fromarray(codes).save(folder / "in" / "photo.png")
    channels, facts = run(folder, SMALLER, image="photo.png")
    f = facts["factor"]
    boxes = codes[: H // f * f, : W // f * f, 3].reshape(H // f, f, W // f, f)
    np.testing.assert_allclose(channels.pop("alpha"), boxes.mean((1, 3)) / 255, atol=1e-6)
    assert f == 2 and set(channels) == CHANNELS
    Image.fromarray(codes | np.array([0, 0, 0, 255], np.uint8)).save(folder / "in" / "photo.png")
    assert set(run(folder, image="photo.png")[0]) == CHANNELS


def refused(folder, **facts):
    error = refusal(".", run, folder, **facts)
    assert error.file and "photos[kitchen]" in error.key
    assert not list((folder / "out").iterdir()), "something half-written"
    return str(error)


def test_channels_say_what_photo_and_mask_say_in_the_same_bytes_again(folder):
    channels, summary = run(folder)
    assert set(channels) == CHANNELS
    np.testing.assert_array_equal(np.dstack([channels[c] for c in "RGB"]), RADIANCE)
    np.testing.assert_array_equal(channels["label"], np.where(LABEL == 255, 0, LABEL))
    np.testing.assert_array_equal(channels["valid"], (LABEL > 0) & (LABEL < 255))
    np.testing.assert_array_equal(channels["left_out"], LABEL == 255)
    assert not channels["object"].any() and not channels["clipped.R"].any()
    assert summary == {
        "width": W, "height": H, "factor": 1, "original_size": [W, H], "focal_px": None, "focal_source": None,
        "encoding": "linear",
        "exposure": None, "illumination": "kitchen", "pixels": {"red": 56, "wood": 96}, "clipped_fraction": 0.0,
    }  # fmt: skip
    first = {path.name: path.read_bytes() for path in (folder / "out").iterdir()}
    run(folder)
    assert first == {path.name: path.read_bytes() for path in (folder / "out").iterdir()}
    np.testing.assert_array_equal(run(folder, objects=OWN)[0]["object"], 2 * (LABEL == 2))


def test_nan_pixels_are_not_valid_and_are_told_and_nothing_but_nan_is_refused(folder, caplog):
    radiance = RADIANCE.copy()
    radiance[2, 3, 1], radiance[3, 3, 0] = np.nan, np.inf
    write_rgb_exr(folder / "in" / "photo.exr", radiance)
    channels, summary = run(folder)
    assert channels["valid"][2, 3] == channels["valid"][3, 3] == 0 and summary["pixels"]["red"] == 54
    assert channels["label"][2, 3] == 1 and all(np.isfinite(channel).all() for channel in channels.values())
    assert "2 of the 152 pixels" in caplog.text and "photo.exr" in caplog.text
    radiance[(LABEL > 0) & (LABEL < 255)] = np.nan
    write_rgb_exr(folder / "in" / "photo.exr", radiance)
    [path.unlink() for path in (folder / "out").iterdir()]
    message = refused(folder)
    assert "photo.exr" in message and "NaN" in message


def test_focal_of_the_dataset_goes_before_exif_and_is_of_the_photo_as_it_is(folder):
    spec = oiio.ImageSpec(W, H, 3, oiio.UINT8)
    spec.attribute("Exif:FocalLengthIn35mmFilm", 50)
    output = oiio.ImageOutput.create("photo.jpg")
    assert output.open(str(folder / "in" / "photo.jpg"), spec) and output.write_image(np.full((H, W, 3), 90, np.uint8))
    output.close()
    for facts, source, expected in ((812.0, "dataset", 812.0), (None, "exif", 50 / np.hypot(36, 24) * np.hypot(W, H))):
        summary = run(folder, image="photo.jpg", focal_px=facts)[1]
        assert summary["focal_source"] == source and summary["focal_px"] == pytest.approx(expected)
    assert run(folder, params=SMALLER, focal_px=812.0)[1]["focal_px"] == 406.0


def test_photos_that_are_too_large_and_masks_that_averaging_loses_are_refused(folder):
    refusal(r"megapixels; at most 0\.0001", run, folder, params={"most_megapixels": 0.0001})
    specks = np.zeros((H, W), np.uint8)
    specks[::4, ::4] = 1
    Image.fromarray(specks).save(folder / "in" / "mask.png")
    refusal("specks", run, folder, params={"frame": 100})  # that averaging loses


def test_a_photo_of_many_pixels_is_averaged_down_and_says_so(folder):
    channels, summary = run(folder, params=SMALLER, objects=OWN)
    mean, label = RADIANCE.reshape(H // 2, 2, W // 2, 2, 3).mean((1, 3)), box_majority(LABEL, 2)
    np.testing.assert_allclose(np.dstack([channels[c] for c in "RGB"]), mean, rtol=1e-6)
    np.testing.assert_array_equal(channels["label"], np.where(label == 255, 0, label))
    np.testing.assert_array_equal(channels["left_out"], label == 255)
    np.testing.assert_array_equal(channels["object"], 2 * box_majority((LABEL == 2).astype("u1"), 2))
    np.testing.assert_array_equal(channels["valid"], channels["label"] > 0)
    assert (summary["factor"], summary["original_size"]) == (2, [W, H])
    assert (summary["width"], summary["height"]) == (W // 2, H // 2)
    assert summary["pixels"] == {"red": int((label == 1).sum()), "wood": int((label == 2).sum())}


def test_averaging_says_where_a_part_is_clipped_or_not_finite(folder):
    radiance = RADIANCE.copy()
    radiance[2, 3], radiance[4:6, 4:6] = np.nan, np.inf
    write_rgb_exr(folder / "in" / "photo.exr", radiance)
    channels, _ = run(folder, params=SMALLER)
    assert channels["valid"][1, 1] == 1 and channels["valid"][2, 2] == 0
    assert channels["R"][1, 1] == pytest.approx(np.delete(RADIANCE[2:4, 2:4, 0].ravel(), 1).mean())
    codes = np.full((H, W, 3), 90, np.uint8)
    codes[3, 3, 1] = 255
    Image.fromarray(codes).save(folder / "in" / "photo.png")
    channels, summary = run(folder, image="photo.png", params=SMALLER)
    assert np.argwhere(channels["clipped.G"]).tolist() == [[1, 1]]
    assert summary["clipped_fraction"] == pytest.approx(1 / sum(summary["pixels"].values()))


METERED = """
import json, sys
from pathlib import Path
from factorlib.runner.worker import Meter
from factorlib.stage import Inputs
from stages import masks

folder, facts = Path(sys.argv[1]), json.loads(sys.argv[2])
meter = Meter()
masks.main(masks.Params(), Inputs({}, facts, {name: folder / name for name in ("a.jpg", "a.png")}, "a"), folder)
print(json.dumps(meter.read(1)))
"""
MOST_MB = 900  # floating-point radiance of the photo alone would be 576; 300 are Python and its libraries


@pytest.mark.long
def test_a_photo_of_48_megapixels_is_read_in_strips_within_the_memory_of_a_step(tmp_path):
    wave = np.sin(np.arange(8000) / 50)[None] * np.sin(np.arange(6000) / 70)[:, None]
    picture = np.repeat((110 + 100 * wave).astype(np.uint8)[..., None], 3, axis=2)
    Image.fromarray(picture).save(tmp_path / "a.jpg", quality=90)
    label = np.zeros((6000, 8000), np.uint8)
    label[1000:5000, 2000:6000], label[2000:4000, 3000:5000] = 1, 2  # a third of the photo
    Image.fromarray(label).save(tmp_path / "a.png", compress_level=1)
    del wave, label, picture
    facts = {
        "dataset.photo": {**GIVEN, "image": "a.jpg", "masks": "a.png", "objects": []},
        "dataset.materials": MATERIALS,
    }
    command = [sys.executable, "-c", METERED, str(tmp_path), json.dumps(facts)]
    cost = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    summary = json.loads((tmp_path / "a.json").read_text())
    assert summary["factor"] == 4 and sum(summary["pixels"].values()) == 1_000_000
    assert (summary["width"], summary["height"]) == (2000, 1500) and cost["memory_mb"] < MOST_MB


def test_a_lens_is_undone_in_photo_and_masks_alike(folder):
    camera = {"focal_px": 20.0, "principal_point": None, "distortion": [0.6, 0.0]}
    plain, _ = run(folder)
    bent, summary = run(folder, camera=camera, focal_px=20.0)
    middle = np.s_[H // 2 - 1 : H // 2 + 1, W // 2 - 1 : W // 2 + 1]
    np.testing.assert_array_equal(bent["label"][middle], plain["label"][middle])
    assert bent["left_out"][0, 0] == 1 and bent["valid"][0, 0] == 0 and bent["label"][0, 0] == 0
    assert 0 < bent["valid"].sum() < plain["valid"].sum() and summary["focal_px"] == 20
    [path.unlink() for path in (folder / "out").iterdir()]
    assert "map two rays" in refused(folder, camera=camera | {"distortion": [-5.0, 0.0]}, focal_px=20.0)


def test_what_a_phone_did_is_said(folder, caplog):
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA401] = 3
    codes = np.rint(255 * srgb_encode(RADIANCE)).astype(np.uint8)
    Image.fromarray(codes).save(folder / "in" / "photo.jpg", exif=exif)
    run(folder, image="photo.jpg")
    assert "processed it (HDR)" in caplog.text and "take it again" in caplog.text
