"""HEIF as phones write it: all of its bits, the right way up, and what the camera wrote."""

import numpy as np
import pytest
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from factorlib.images.photo import decoded, open_photo, read_photo
from factorlib.images.transfer import srgb_decode, srgb_encode

pillow_heif = pytest.importorskip("pillow_heif")
H, W = 48, 64
SMOOTH = np.linspace(0.05, 0.8, W)[None, :, None] * np.linspace(0.6, 1, H)[:, None, None] * np.array([1.0, 0.9, 0.7])


def read_exif(orientation=1) -> bytes:
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
def test_heif_is_the_radiance_that_was_written_in_all_its_bits_and_top_codes_are_clipped(tmp_path, deep, tolerance):
    photo = read_photo(save(tmp_path / "a.heic", SMOOTH, deep=deep))
    assert (photo.width, photo.height, photo.encoding) == (W, H, "srgb") and not photo.clipped.any()
    np.testing.assert_allclose(photo.radiance, SMOOTH, atol=tolerance)
    step = np.full((8, 64, 3), 1.0) * (np.arange(64)[None, :, None] // 8 + 400) / 1023  # eighths of 8 bits' steps
    radiance = read_photo(save(tmp_path / "a.heic", srgb_decode(step), deep=deep)).radiance
    assert len(np.unique(radiance[4, ::8, 1])) == (8 if deep else 2)
    bright = SMOOTH.copy()
    bright[:16, :16] = 1
    clipped = read_photo(save(tmp_path / "a.heic", bright, deep=deep)).clipped
    assert clipped[2:14, 2:14].all() and not clipped[20:].any()


@pytest.mark.parametrize("orientation, turns", [(1, 0), (3, 2), (6, 3), (8, 1)])
def test_orientation_is_applied_once_and_what_the_camera_wrote_is_read(tmp_path, orientation, turns):
    path, turned = save(tmp_path / "a.heic", SMOOTH, exif=read_exif(orientation)), np.rot90(SMOOTH, turns)
    photo, small = read_photo(path), decoded(open_photo(path), None, 4, path)
    assert photo.radiance.shape == turned.shape and open_photo(path).size == turned.shape[:2]
    np.testing.assert_allclose(photo.radiance, turned, atol=0.015)
    assert photo.exposure == pytest.approx(200 / 50 / 4)
    assert photo.focal_px == pytest.approx(26 / np.hypot(36, 24) * np.hypot(W, H))
    assert small.focal_px == pytest.approx(photo.focal_px / 4)
    boxes = photo.radiance.reshape(photo.height // 4, 4, photo.width // 4, 4, 3).mean((1, 3))
    np.testing.assert_allclose(small.radiance, boxes, rtol=1e-5)
    exif = Image.Exif()
    exif[0x112] = orientation
    plane = {0x920A: IFDRational(5, 1), 0xA002: W, 0xA003: H, 0xA20E: IFDRational(1000, 1), 0xA210: 3}
    exif.get_ifd(0x8769).update(plane)
    assert read_photo(save(path, SMOOTH, exif=exif.tobytes())).focal_px == pytest.approx(5 * 1000 / 10)
