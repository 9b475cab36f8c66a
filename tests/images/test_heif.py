"""HEIF as phones write it: all of its bits, the right way up, and what the camera wrote."""

import numpy as np
import pytest
from PIL import Image, ImageCms
from PIL.TiffImagePlugin import IFDRational

from factorlib.errors import InputError
from factorlib.images.heif import is_heif
from factorlib.images.photo import decoded, open_photo, read_photo
from factorlib.images.transfer import srgb_decode, srgb_encode

pillow_heif = pytest.importorskip("pillow_heif")
H, W = 48, 64
SMOOTH = np.linspace(0.05, 0.8, W)[None, :, None] * np.linspace(0.6, 1, H)[:, None, None] * np.array([1.0, 0.9, 0.7])


def exif_of(orientation=1) -> bytes:
    exif = Image.Exif()
    exif[0x112] = orientation
    exif.get_ifd(0x8769).update({0x829A: IFDRational(1, 50), 0x829D: IFDRational(2, 1), 0x8827: 200, 0xA405: 26})
    return exif.tobytes()


def save(path, radiance, *, deep=False, **options):
    """sRGB codes of 8 or 10 bits."""
    kind, mode = (np.uint16, "RGB;16") if deep else (np.uint8, "RGB")
    codes = np.rint(srgb_encode(radiance) * np.iinfo(kind).max).astype(kind)
    pillow_heif.from_bytes(mode, codes.shape[1::-1], codes.tobytes()).save(path, quality=-1, chroma=444, **options)
    return path


@pytest.mark.parametrize("deep, tolerance", [(False, 0.015), (True, 0.005)])
def test_heif_is_the_radiance_that_was_written(tmp_path, deep, tolerance):
    photo = read_photo(save(tmp_path / "a.heic", SMOOTH, deep=deep))
    assert (photo.width, photo.height, photo.encoding) == (W, H, "srgb")
    np.testing.assert_allclose(photo.radiance, SMOOTH, atol=tolerance)
    assert not photo.clipped.any()


def test_ten_bits_are_read_as_ten(tmp_path):
    step = srgb_decode(
        np.full((8, 64, 3), 1.0) * (np.arange(64)[None, :, None] // 8 + 400) / 1023
    )  # an eighth of 8 bits' steps
    radiance = read_photo(save(tmp_path / "a.heic", step, deep=True)).radiance
    assert len(np.unique(radiance[4, ::8, 1])) == 8


def test_top_codes_are_clipped(tmp_path):
    bright = SMOOTH.copy()
    bright[:16, :16] = 1
    clipped = read_photo(save(tmp_path / "a.heic", bright, deep=True)).clipped
    assert clipped[2:14, 2:14].all() and not clipped[20:].any()


@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_orientation_is_applied_once(tmp_path, orientation):
    turns = {1: 0, 3: 2, 6: 3, 8: 1}[orientation]
    path = save(tmp_path / "a.heic", SMOOTH, exif=exif_of(orientation))
    photo = read_photo(path)
    assert photo.radiance.shape == np.rot90(SMOOTH, turns).shape
    np.testing.assert_allclose(photo.radiance, np.rot90(SMOOTH, turns), atol=0.015)
    assert open_photo(path).size == photo.radiance.shape[:2]


def test_what_the_camera_wrote_is_read_and_averaging_is_as_for_any_file(tmp_path):
    path = save(tmp_path / "a.heic", SMOOTH, exif=exif_of())
    whole, small = read_photo(path), decoded(open_photo(path), None, 4, path)
    assert whole.exposure == pytest.approx(200 / 50 / 4)
    assert whole.focal_px == pytest.approx(26 / np.hypot(36, 24) * np.hypot(W, H)) and small.focal_px == pytest.approx(
        whole.focal_px / 4
    )
    np.testing.assert_allclose(small.radiance, whole.radiance.reshape(12, 4, 16, 4, 3).mean((1, 3)), rtol=1e-5)


def test_a_focal_plane_that_was_turned_tells_the_same_focal_length(tmp_path):
    focal = []
    for orientation in (1, 6):
        exif = Image.Exif()
        exif[0x112] = orientation
        plane = {0x920A: IFDRational(5, 1), 0xA002: W, 0xA003: H, 0xA20E: IFDRational(1000, 1), 0xA210: 3}
        exif.get_ifd(0x8769).update(plane)
        focal.append(read_photo(save(tmp_path / "a.heic", SMOOTH, exif=exif.tobytes())).focal_px)
    assert focal[0] == focal[1] == pytest.approx(5 * 1000 / 10)


def test_the_kind_is_told_by_the_content(tmp_path):
    save(tmp_path / "a.heic", SMOOTH).rename(tmp_path / "a.jpg")
    assert is_heif(tmp_path / "a.jpg") and read_photo(tmp_path / "a.jpg").width == W
    (tmp_path / "b.heic").write_bytes(b"no picture")
    with pytest.raises(InputError, match="not readable as an image"):
        read_photo(tmp_path / "b.heic")


@pytest.mark.parametrize("part", [0.3, 0.6, 0.98])
def test_a_damaged_file_is_refused(tmp_path, part):
    noise = np.random.default_rng(0).random((H, W, 3))
    whole = save(tmp_path / "a.heic", noise).read_bytes()
    (tmp_path / "a.heic").write_bytes(whole[: int(part * len(whole))])
    with pytest.raises(InputError) as caught:
        read_photo(tmp_path / "a.heic", key="photos[0].image")
    assert "photos[0].image" in str(caught.value) and caught.value.cure


def test_a_picture_of_another_size_than_its_header_says_is_refused(tmp_path):
    whole = save(tmp_path / "a.heic", SMOOTH).read_bytes()
    at = whole.index(b"clap") + 12  # the height of the crop: past the name and the width, a fraction
    (tmp_path / "a.heic").write_bytes(whole[:at] + (255).to_bytes(4, "big") + whole[at + 4 :])
    with pytest.raises(
        InputError, match=r"truncated or damaged \(its header says .*×255 pixels, the picture in it has "
    ) as caught:
        read_photo(tmp_path / "a.heic", key="photos[0].image")
    assert "photos[0].image" in str(caught.value) and caught.value.cure


def test_a_file_in_a_curve_of_hdr_video_is_refused(tmp_path):
    path = save(
        tmp_path / "a.heic", SMOOTH, deep=True, save_nclx_profile=True, transfer_characteristics=18, color_primaries=9
    )
    with pytest.raises(InputError, match="HLG"):
        read_photo(path)


def test_a_wider_colour_profile_is_told(tmp_path, caplog):
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("LAB"))
    read_photo(save(tmp_path / "a.heic", SMOOTH, icc_profile=profile.tobytes()))
    assert "its colour profile is" in caplog.text
