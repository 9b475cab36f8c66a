"""Photos: the same scene is the same radiance whatever file it came in, also raw and HEIF."""

import io
import os
import struct
import zlib
from itertools import accumulate

import numpy as np
import OpenImageIO as oiio
import pytest
from PIL import Image
from PIL.TiffImagePlugin import IFDRational, ImageFileDirectory_v2
from PIL.TiffTags import LONG, RATIONAL, SHORT

from factorlib.images.exr import read_exr
from factorlib.images.light_map import read_light_map
from factorlib.images.photo import box_mean, check_bright, decode_photo, open_photo, read_photo
from factorlib.images.tone import srgb_decode, srgb_encode
from tests.faults import sample
from tests.images.made_dng import BLACK, WHITE, write_dng
from tests.refusal import refusal

RNG = np.random.default_rng(3)
RADIANCE = RNG.uniform(0, 0.9, (12, 18, 3)).astype(np.float32)  # 3:2, below clipping


def save(path, pixels, names=None, window=(), **attributes):
    """Write an image in the type of `pixels`; attribute names with `__` for `:`."""
    image = oiio.ImageBuf(np.ascontiguousarray(pixels))
    spec = image.specmod()
    spec.attribute("oiio:UnassociatedAlpha", 1)
    if names:
        spec.channelnames = names
        spec.alpha_channel = names.index("A") if "A" in names else -1
    for name, value in attributes.items():
        kind = {"chromaticities": ["float[8]"], "ICCProfile": [f"uint8[{np.size(value)}]"]}.get(name, [])
        spec.attribute(name.replace("__", ":"), *kind, value)
    for name, value in dict(window).items():
        setattr(spec, name, value)
    assert image.write(str(path)), image.geterror()
    return path


def codes(encoded, kind=np.uint8):
    return np.rint(encoded * np.iinfo(kind).max).astype(kind)


@pytest.mark.parametrize("file, pixels, tolerance", [
    *((f"a.{suffix}", codes(srgb_encode(RADIANCE)), 5e-3) for suffix in ("png", "tif")),
    *((f"b.{suffix}", codes(srgb_encode(RADIANCE), np.uint16), 2e-5) for suffix in ("png", "tif")),
    *((f"c.{suffix}", RADIANCE, tolerance) for suffix, tolerance in (("tif", 0), ("exr", 0), ("hdr", 5e-3))),
    ("d.exr", RADIANCE.astype(np.float16), 5e-4),
])  # fmt: skip
def test_every_kind_of_file_gives_the_same_radiance(tmp_path, file, pixels, tolerance):
    photo = read_photo(save(tmp_path / file, pixels))
    assert photo.radiance.dtype == np.float32
    assert np.abs(photo.radiance - RADIANCE).max() <= tolerance
    assert not photo.clipped.any() and photo.finite.all() and (photo.width, photo.height) == (18, 12)
    assert photo.encoding == ("linear" if pixels.dtype.kind == "f" else "srgb")


@pytest.mark.parametrize("encoding, encode", [
    ("srgb", srgb_encode), ("gamma2.2", lambda linear: linear ** (1 / 2.2)), ("linear", np.asarray),
])  # fmt: skip
def test_a_given_encoding_goes_before_what_the_file_implies(tmp_path, encoding, encode):
    for file, pixels in (("a.png", codes(encode(RADIANCE), np.uint16)), ("a.exr", encode(RADIANCE))):
        photo = read_photo(save(tmp_path / file, pixels), encoding)
        assert photo.radiance == pytest.approx(RADIANCE, abs=5e-5) and photo.encoding == encoding
    smooth = np.broadcast_to(np.linspace(0.1, 0.8, 48)[None, :, None], (32, 48, 3))
    jpeg = save(tmp_path / "a.jpg", codes(encode(smooth)), Compression="jpeg:98")
    assert read_photo(jpeg, encoding).radiance == pytest.approx(smooth, abs=0.02)


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("file, pixels", [("a.tif", codes(srgb_encode(RADIANCE))), ("a.exr", RADIANCE)])
def test_orientation_is_applied_before_averaging_down(tmp_path, orientation, file, pixels):
    pixels = np.ascontiguousarray(pixels[:11, :17])  # nothing comes out even, so that the displayed corner matters
    path = save(tmp_path / file, pixels, Orientation=orientation)
    expected = oiio.ImageBufAlgo.reorient(oiio.ImageBuf(str(path))).get_pixels(oiio.FLOAT)
    whole, small = read_photo(path), decode_photo(open_photo(path), None, 3, path)
    assert (whole.height, whole.width) == expected.shape[:2] == ((17, 11) if orientation >= 5 else (11, 17))
    shown = srgb_encode(whole.radiance) if file == "a.tif" else whole.radiance
    np.testing.assert_allclose(shown, expected, atol=1e-5)
    assert small.radiance.shape == tuple(n // 3 for n in whole.radiance.shape[:2]) + (3,)
    assert (small.height, small.width, small.factor) == (*small.radiance.shape[:2], 3)
    np.testing.assert_allclose(small.radiance, box_mean(whole.radiance, whole.finite, 3)[0], rtol=1e-6)


@pytest.mark.parametrize("aperture, iso, expected", [
    (1.8, 125, 125 / 60 / 1.8**2), (1.8, None, None), (0.0, 125, None), (1.8, 65535, None),  # a lens that says nothing; "more than fits"
])  # fmt: skip
def test_the_exposure_is_what_the_camera_wrote(tmp_path, aperture, iso, expected):
    tags = {"ExposureTime": 1 / 60, "FNumber": aperture} | ({"Exif__PhotographicSensitivity": iso} if iso else {})
    exposure = read_photo(save(tmp_path / "a.jpg", np.zeros((40, 60, 3), dtype=np.uint8), **tags)).exposure
    assert exposure == (None if expected is None else pytest.approx(expected, rel=1e-3))


@pytest.mark.parametrize("channels, names", [(1, ["Y"]), (2, ["Y", "A"]), (4, ["R", "G", "B", "A"])])
@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_grey_becomes_rgb_and_alpha_is_dropped_without_darkening(tmp_path, channels, names, suffix):
    pixels = np.full((4, 6, channels), 100, dtype=np.uint8)
    if "A" in names:
        pixels[..., -1] = 40
    photo = read_photo(save(tmp_path / f"a{suffix}", pixels, names))
    assert photo.radiance.shape == (4, 6, 3)
    assert codes(srgb_encode(photo.radiance)).tolist() == np.full((4, 6, 3), 100).tolist()


PARTS = {  # names of parts, and of their channels -> values of the pixels, 10 · part + channel, or words of the error
    "channels by name": ([("", ["Z", "B", "R", "G"])], [2, 3, 1]),
    "Blender's layers": ([("", ["V.Depth.Z", *(f"V.{layer}.{c}" for layer in ("DiffCol", "Combined") for c in "BGR")])], [6, 5, 4]),
    "the unnamed layer": ([("", ["albedo.R", "albedo.G", "albedo.B", "B", "G", "R"])], [5, 4, 3]),
    "the only layer of colours": ([("", ["N.X", "N.Y", "N.Z", "colour.R", "colour.G", "colour.B"])], [3, 4, 5]),
    "no colours": ([("", ["normal.x", "normal.y"])], "normal.x, normal.y"),
    "beauty after others": ([("albedo", "RGB"), ("rgba", "RGBA"), ("normal", "RGB")], [10, 11, 12]),
    "Blender's": ([("ViewLayer.DiffCol", "RGB"), ("ViewLayer.Combined", "RGB")], [10, 11, 12]),
    "the only colours": ([("depth", "Z"), ("picture", "RGB"), ("normal", "XYZ")], [10, 11, 12]),
    "the largest": ([("preview", "RGB"), ("picture", "RGB")], [10, 11, 12]),
    "two views": ([("left", "RGB"), ("right", "RGB")], "which one is the photo is not clear: left, right"),
    "two beauties": ([("a.Combined", "RGB"), ("b.Combined", "RGB")], "not clear: a.Combined, b.Combined"),
    "pages": ([("", "RGB"), ("", "RGB")], "not clear: page 1, page 2"),
}  # fmt: skip


@pytest.mark.parametrize("case", PARTS)
def test_the_part_or_layer_of_a_file_that_is_the_picture_is_read_or_asked_for(tmp_path, case):
    parts, expected = PARTS[case]
    is_tiff = case in ("pages", "the largest")
    path = tmp_path / ("a.tif" if is_tiff else "a.exr")
    specs = [oiio.ImageSpec(18 - 9 * (name == "preview"), 12, len(channels), oiio.FLOAT) for name, channels in parts]
    for spec, (name, channels) in zip(specs, parts):
        spec.channelnames = list(channels)
        spec.attribute("oiio:subimagename", name)
    output = oiio.ImageOutput.create(str(path))
    assert output.open(str(path), specs[0] if is_tiff else specs)
    for k, spec in enumerate(specs):
        assert k == 0 or output.open(str(path), spec, "AppendSubimage")
        values = np.arange(10 * k, 10 * k + spec.nchannels, dtype=np.float32)
        assert output.write_image(np.tile(values, (spec.height, spec.width, 1)))
    output.close()
    if isinstance(expected, str):
        refusal(expected, open_photo, path)
    else:
        assert (read_photo(path).radiance == expected).all() and read_photo(path).width == 18


def test_other_kinds_of_files_are_refused_by_name(tmp_path):
    refusal("codes are of type int16", open_photo, save(tmp_path / "a.tif", codes(RADIANCE, np.int16)))
    refusal("of aspect 2", open_photo, save(tmp_path / "a.exr", RADIANCE, PixelAspectRatio=2.0))
    path = save(tmp_path / "a.hdr", RADIANCE)
    path.write_bytes(path.read_bytes().replace(b"rle_rgbe", b"rle_xyze"))
    assert "ra_xyze -r a.hdr" in refusal("is a Radiance picture of XYZE", open_photo, path).cure
    path.write_bytes(b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 12 +X 18\n" + 12 * b"\x80\x80\x80\x80\1\1\1\x11")
    assert "ra_xyze" in refusal("truncated or damaged", read_photo, path).cure
    jpeg = save(tmp_path / "a.jpg", np.random.default_rng(0).integers(0, 255, (96, 96, 3), np.uint8)).read_bytes()
    path.write_bytes(jpeg[: len(jpeg) // 2] + b"\xff\xd9")  # a part is lost, though the file has an end
    refusal("truncated or damaged", read_photo, path)


XMP = (  # of a JPEG with a gain map, and of the map
    '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"><rdf:Description '
    'xmlns:C="http://ns.google.com/photos/1.0/container/" xmlns:I="http://ns.google.com/photos/1.0/container/item/" '
    'xmlns:hdrgm="http://ns.adobe.com/hdr-gain-map/1.0/" hdrgm:Version="1.0" %s</rdf:Description></rdf:RDF></x:xmpmeta>'
)
MAP = 'hdrgm:GainMapMin="0" hdrgm:GainMapMax="3" hdrgm:HDRCapacityMax="3">'
PICTURE = (
    '><C:Directory><rdf:Seq><rdf:li rdf:parseType="Resource"><C:Item I:Semantic="Primary" I:Mime="image/jpeg"/></rdf:li><rdf:li '
    'rdf:parseType="Resource"><C:Item I:Semantic="GainMap" I:Mime="image/jpeg" I:Length="%d"/></rdf:li></rdf:Seq></C:Directory>'
)


@pytest.mark.parametrize("encoding", [None, "srgb"])
def test_a_jpeg_with_a_gain_map_is_the_picture_that_other_programs_show(tmp_path, encoding):
    picture = Image.fromarray(np.broadcast_to(np.linspace(20, 255, 36, dtype=np.uint8)[:, None], (24, 36, 3)).copy())
    picture.convert("L").save(tmp_path / "map.jpg", xmp=(XMP % MAP).encode())
    gain = (tmp_path / "map.jpg").read_bytes()
    picture.save(tmp_path / "a.jpg", xmp=(XMP % (PICTURE % len(gain))).encode())
    plain = read_photo(tmp_path / "a.jpg", encoding)
    (tmp_path / "a.jpg").write_bytes((tmp_path / "a.jpg").read_bytes() + gain)
    assert oiio.ImageInput.open(str(tmp_path / "a.jpg")).spec().format == oiio.HALF  # as OpenImageIO reads it
    photo = read_photo(tmp_path / "a.jpg", encoding)
    assert np.array_equal(photo.radiance, plain.radiance) and photo.encoding == "srgb"
    assert np.array_equal(photo.clipped, plain.clipped) and photo.clipped.any()


AP1 = (0.713, 0.293, 0.165, 0.83, 0.128, 0.044, 0.32168, 0.33767)  # ACES: red, green, blue, white
AP0 = (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.077, 0.32168, 0.33767)
REC709 = (0.64, 0.33, 0.3, 0.6, 0.15, 0.06, 0.3127, 0.329)
XYZ = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])  # of sRGB, IEC 61966-2-1


@pytest.mark.parametrize("suffix", ["exr", "hdr"])
def test_colours_of_other_primaries_are_rec709_and_those_of_rec709_the_same_bits(tmp_path, suffix):
    def read(primaries, pixels):
        path = save(tmp_path / f"a.{suffix}", pixels, **({} if suffix == "hdr" else {"chromaticities": primaries}))
        line = b"\nPRIMARIES=%s\nFORMAT" % " ".join(map(str, primaries)).encode()
        path.write_bytes(path.read_bytes().replace(b"\nFORMAT", line))
        return read_photo(path).radiance

    plain = read_photo(save(tmp_path / f"b.{suffix}", RADIANCE)).radiance
    assert np.array_equal(read(REC709, RADIANCE), plain)
    red = XYZ @ read(AP1, np.full((2, 8, 3), (0.5, 0, 0), np.float32))[0, 0]
    assert red / red.sum() == pytest.approx([0.713, 0.293, -0.006], abs=1e-3) and red[1] == pytest.approx(
        0.5 * 0.2722, abs=1e-3
    )
    for space in (AP1, AP0):
        white = XYZ @ read(space, np.ones((2, 8, 3), np.float32))[0, 0]
        assert white / white.sum() == pytest.approx([0.32168, 0.33767, 0.34065], abs=1e-3)
    assert np.array_equal(read((0,) * 8, RADIANCE), plain)  # as OpenImageIO writes what it does not know
    refusal("chromaticities", read, (0.3, 0.4) * 4, RADIANCE)


@pytest.mark.parametrize("left, top", [(2, 1), (-3, -2), (20, 1), (2, 13)])
def test_the_pixels_of_an_exr_lie_where_its_display_window_says(tmp_path, left, top):
    window = {"x": 5 + left, "y": 7 + top, "full_x": 5, "full_y": 7, "full_width": 20, "full_height": 13}
    photo = read_photo(save(tmp_path / "a.exr", RADIANCE, window=window))
    expected = np.full((60, 60, 3), np.nan)
    expected[20 + top : 32 + top, 20 + left : 38 + left] = RADIANCE
    expected = expected[20:33, 20:40]
    assert np.array_equal(photo.finite, np.isfinite(expected[..., 0]))
    assert np.array_equal(photo.radiance, np.nan_to_num(expected))


def test_top_codes_are_clipped_and_what_is_not_finite_is_no_pixel_however_bright_floats_are(tmp_path):
    for kind, top, below in ((np.uint8, (254, 255), 253), (np.uint16, (65300, 65535), 65000)):
        pixels = np.full((2, 3, 3), below, dtype=kind)
        pixels[0, 0, 0], pixels[1, 2, 2] = top
        clipped = read_photo(save(tmp_path / "a.png", pixels)).clipped
        assert np.argwhere(clipped).tolist() == [[0, 0, 0], [1, 2, 2]]
    pixels = np.full((2, 3, 3), 50.0, dtype=np.float32)
    pixels[0, 0, 1], pixels[1, 1, 2] = np.nan, np.inf
    photo = read_photo(save(tmp_path / "a.exr", pixels))
    assert np.argwhere(~photo.finite).tolist() == [[0, 0], [1, 1]]
    assert not photo.clipped.any() and np.isfinite(photo.radiance).all() and photo.radiance[0, 1, 0] == 50


def test_a_photo_that_is_black_or_negative_wherever_it_is_used_and_a_pipe_are_refused_by_name(tmp_path):
    pixels, inside = np.ones((4, 6, 3), np.float32), np.ones((4, 6), bool)
    for value in (0.0, -1.0):
        pixels[1:], inside[0] = value, False
        photo = read_photo(save(tmp_path / "kitchen.exr", pixels))
        check_bright(photo, np.ones((4, 6), bool), "kitchen.exr")
        caught = refusal("black, or less than 0", check_bright, photo, inside, "kitchen.exr", "photos[kitchen].image")
        assert "kitchen.exr: photos[kitchen].image" in str(caught) and "remove the photo" in caught.cure
    os.mkfifo(tmp_path / "pipe.exr")
    for read in (read_exr, read_light_map):
        refusal("is a pipe", read, tmp_path / "pipe.exr")


# ── Raw photos: what the sensor saw, not the preview beside it; linear, and clipped where the sensor was ────────────


H, W = 48, 64
EXIF = {
    33434: (RATIONAL, [1 / 50]),
    33437: (RATIONAL, [2.0]),
    34855: (SHORT, [200]),
    41989: (SHORT, [26]),
    40962: (LONG, [W]),
}


def sensor_of(rgb: np.ndarray) -> np.ndarray:
    """Codes of a sensor that sees linear `rgb` in [0, 1], [h, w, 3]."""
    codes = BLACK + rgb * (WHITE - BLACK)
    pattern = np.array([[0, 1], [1, 2]])[np.arange(rgb.shape[0])[:, None] % 2, np.arange(rgb.shape[1])[None] % 2]
    return np.rint(np.take_along_axis(codes, pattern[..., None], axis=2)[..., 0]).astype(np.uint16)


def halves() -> np.ndarray:
    """Left grey of .2, right (.4, .3, .2); an upper band of half of it."""
    rgb = np.full((H, W, 3), 0.2)
    rgb[:, W // 2 :] = (0.4, 0.3, 0.2)
    rgb[: H // 3] /= 2
    return rgb


@pytest.mark.parametrize("name", ["a.dng", "A.DNG", "a.tif"])
def test_a_dng_is_what_the_sensor_saw_by_whatever_name_however_bright_the_picture(tmp_path, name):
    for brightness in (1, 0.25):
        photo = read_photo(write_dng(tmp_path / name, sensor_of(brightness * halves()), exif=EXIF))
        assert (photo.width, photo.height, photo.encoding) == (W, H, "linear") and not photo.clipped.any()
        for where, expected in (
            (np.s_[H // 3 + 4 : -4, 4 : W // 2 - 4], (0.2, 0.2, 0.2)),
            (np.s_[H // 3 + 4 : -4, W // 2 + 4 : -4], (0.4, 0.3, 0.2)),
            (np.s_[4 : H // 3 - 4, 4 : W // 2 - 4], (0.1, 0.1, 0.1)),
        ):
            radiance = photo.radiance[where].mean((0, 1))
            np.testing.assert_allclose(radiance, np.multiply(expected, brightness), rtol=0.02)
    assert photo.exposure == pytest.approx(200 / 50 / 4)
    assert photo.focal_px == pytest.approx(26 / np.hypot(36, 24) * np.hypot(W, H))


def test_the_cameras_white_balance_is_applied(tmp_path):
    radiance = halves() * (0.5, 1.0, 0.8)  # the sensor sees less red and blue
    lower = read_photo(write_dng(tmp_path / "a.dng", sensor_of(radiance), neutral=(0.5, 1.0, 0.8))).radiance[
        H // 2 : -4
    ]
    grey, coloured = lower[:, 6 : W // 2 - 6].mean((0, 1)), lower[:, W // 2 + 6 : -4].mean((0, 1))
    np.testing.assert_allclose(grey / grey[1], 1, rtol=0.02)
    np.testing.assert_allclose(coloured / grey, (2, 1.5, 1), rtol=0.03)


def test_what_the_sensors_white_level_cut_is_clipped_in_all_channels(tmp_path):
    sensor = sensor_of(halves())
    sensor[24:26, 40:42] = WHITE
    clipped = read_photo(write_dng(tmp_path / "a.dng", sensor)).clipped
    assert clipped[24:26, 40:42].all()
    assert not (clipped[:20].any() or clipped[30:].any() or clipped[:, :36].any())


def test_a_damaged_raw_file_is_refused_with_the_command_that_develops_it(tmp_path):
    whole = write_dng(tmp_path / "a.dng", sensor_of(halves())).read_bytes()
    for broken in (b"no raw file", whole[:100], whole[: len(whole) // 2]):
        (tmp_path / "a.dng").write_bytes(broken)
        caught = refusal(".", read_photo, tmp_path / "a.dng", key="photos[0].image")
        assert "photos[0].image" in str(caught) and "darktable-cli a.dng a.tif" in str(caught)


# ── HEIF as phones write it: all of its bits, the right way up, and what the camera wrote ───────────────────────────


pillow_heif = pytest.importorskip("pillow_heif")
SMOOTH = np.linspace(0.05, 0.8, W)[None, :, None] * np.linspace(0.6, 1, H)[:, None, None] * np.array([1.0, 0.9, 0.7])


def exif_of(orientation, tags) -> bytes:
    exif = Image.Exif()
    exif[0x112] = orientation
    exif.get_ifd(0x8769).update(tags)
    return exif.tobytes()


def save_heif(path, radiance, *, deep=False, **options):
    """sRGB codes of 8 or 10 bits."""
    kind, mode = (np.uint16, "RGB;16") if deep else (np.uint8, "RGB")
    codes = np.rint(srgb_encode(radiance) * np.iinfo(kind).max).astype(kind)
    pillow_heif.from_bytes(mode, codes.shape[1::-1], codes.tobytes()).save(path, quality=-1, chroma=444, **options)
    return path


@pytest.mark.parametrize("deep, tolerance", [(False, 0.015), (True, 0.005)])
def test_heif_is_the_radiance_that_was_written_in_all_its_bits_and_top_codes_are_clipped(tmp_path, deep, tolerance):
    photo = read_photo(save_heif(tmp_path / "a.heic", SMOOTH, deep=deep))
    assert (photo.width, photo.height, photo.encoding) == (W, H, "srgb") and not photo.clipped.any()
    np.testing.assert_allclose(photo.radiance, SMOOTH, atol=tolerance)
    step = np.full((8, 64, 3), 1.0) * (np.arange(64)[None, :, None] // 8 + 400) / 1023  # eighths of 8 bits' steps
    radiance = read_photo(save_heif(tmp_path / "a.heic", srgb_decode(step), deep=deep)).radiance
    assert len(np.unique(radiance[4, ::8, 1])) == (8 if deep else 2)
    bright = SMOOTH.copy()
    bright[:16, :16] = 1
    clipped = read_photo(save_heif(tmp_path / "a.heic", bright, deep=deep)).clipped
    assert clipped[2:14, 2:14].all() and not clipped[20:].any()


@pytest.mark.parametrize("orientation, turns", [(1, 0), (3, 2), (6, 3), (8, 1)])
def test_orientation_is_applied_once_and_what_the_camera_wrote_is_read(tmp_path, orientation, turns):
    tags = {0x829A: IFDRational(1, 50), 0x829D: IFDRational(2, 1), 0x8827: 200, 0xA405: 26}
    path, turned = save_heif(tmp_path / "a.heic", SMOOTH, exif=exif_of(orientation, tags)), np.rot90(SMOOTH, turns)
    photo, small = read_photo(path), decode_photo(open_photo(path), None, 4, path)
    assert photo.radiance.shape == turned.shape and open_photo(path).size == turned.shape[:2]
    np.testing.assert_allclose(photo.radiance, turned, atol=0.015)
    assert photo.exposure == pytest.approx(200 / 50 / 4)
    assert photo.focal_px == pytest.approx(26 / np.hypot(36, 24) * np.hypot(W, H))
    assert small.focal_px == pytest.approx(photo.focal_px / 4)
    boxes = photo.radiance.reshape(photo.height // 4, 4, photo.width // 4, 4, 3).mean((1, 3))
    np.testing.assert_allclose(small.radiance, boxes, rtol=1e-5)
    plane = {0x920A: IFDRational(5, 1), 0xA002: W, 0xA003: H, 0xA20E: IFDRational(1000, 1), 0xA210: 3}
    turned_exif = exif_of(orientation, plane)
    assert read_photo(save_heif(path, SMOOTH, exif=turned_exif)).focal_px == pytest.approx(5 * 1000 / 10)


# ── Colours of photos: a file is the same radiance in whatever space it is stored, or is refused by name ──────────


# XYZ (D65) of linear RGB, CSS Color Module Level 4, section 17
SRGB = np.array([[0.412391, 0.357584, 0.180481], [0.212639, 0.715169, 0.072192], [0.019331, 0.119195, 0.950532]])
P3 = np.array([[0.486571, 0.265668, 0.198217], [0.228975, 0.691739, 0.079287], [0.0, 0.045113, 1.043944]])
ADOBE = np.array([[0.576669, 0.185558, 0.188229], [0.297345, 0.627364, 0.075291], [0.027031, 0.070689, 0.991338]])
REC2020 = np.array([[0.636958, 0.144617, 0.168881], [0.262700, 0.677998, 0.059302], [0.0, 0.028073, 1.060985]])
D50_FROM_D65 = np.array([[1.047930, 0.022947, -0.050192], [0.029628, 0.990434, -0.017074], [-0.009243, 0.015055, 0.751874]])  # fmt: skip
P3_XY = (0.3127, 0.329, 0.68, 0.32, 0.265, 0.69, 0.15, 0.06)  # white, red, green, blue
ADOBE_XY = (0.3127, 0.329, 0.64, 0.33, 0.21, 0.71, 0.15, 0.06)

# colours of Display P3, of which a corner lies beyond Rec. 709
WIDE = np.random.default_rng(5).uniform(0.05, 0.9, (12, 18, 3)) @ (np.linalg.inv(SRGB) @ P3).T
GREY = np.broadcast_to(np.linspace(0.05, 0.9, 18)[None, :, None], (12, 18, 3))


def stored(space, encode, scene=WIDE):
    """Codes in [0, 1] of the scene in a space of a matrix to XYZ and a curve."""
    return encode((scene @ (np.linalg.inv(space) @ SRGB).T).clip(0, 1))


def icc(space, *curves, model=b"RGB ", names=(b"rTRC", b"gTRC", b"bTRC"), **further):
    """An ICC profile of three curves, or of one for all, and the colorants of a space."""
    xyz = [b"XYZ \0\0\0\0" + np.rint(65536 * c).astype(">i4").tobytes() for c in (D50_FROM_D65 @ space).T]
    tags = {**dict(zip((b"rXYZ", b"gXYZ", b"bXYZ"), xyz)), **dict(zip(names, curves * 3))}
    tags |= {name.encode(): tag for name, tag in further.items()}
    padded = [tag + b"\0" * (-len(tag) % 4) for tag in tags.values()]
    starts = list(accumulate(map(len, padded), initial=132 + 12 * len(tags)))  # of the tags, and the end of the file
    table = b"".join(struct.pack(">4sII", *row) for row in zip(tags, starts, map(len, tags.values())))
    head = struct.pack(">I", starts[-1]) + b"\0" * 4 + b"\2\x10\0\0mntr" + model + b"XYZ " + b"\0" * 12 + b"acsp"
    return head + b"\0" * 88 + struct.pack(">I", len(tags)) + table + b"".join(padded)


def curv(*values):
    return b"curv\0\0\0\0" + struct.pack(f">I{len(values)}H", len(values), *values)


def para(kind, *values):
    return struct.pack(">4s4xHH", b"para", kind, 0) + np.rint(65536 * np.array(values)).astype(">i4").tobytes()


SRGB_PARA = para(3, 2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045)
GAMMA = 563 / 256


def adobe(linear):
    return linear ** (1 / GAMMA)


def rec709(linear):
    return np.where(linear < 0.018, 4.5 * linear, 1.099 * linear**0.45 - 0.099)


def iccp(*arguments, **named):
    return b"name\0\0" + zlib.compress(icc(*arguments, **named))


def png(values, **chunks):
    """A PNG of 16 bits with further chunks."""
    rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in codes(values, np.uint16))
    before = b"".join(sample.chunk(name.encode(), data) for name, data in chunks.items())
    return "a.png", sample.png(sample.png_header(18, 12, 16, 2), zlib.compress(rows), before=before)


def pillow(name, image, **options):
    """An image as Pillow or pillow-heif writes it."""
    stream = io.BytesIO()
    image.save(stream, **({} if name.endswith("heic") else {"format": name}), **options)
    return name, stream.getvalue()


def tiff(values, **tags):
    """A TIFF of 8 bits with further tags, by their numbers."""
    directory = ImageFileDirectory_v2()
    directory.update({int(number[1:]): value for number, value in tags.items()})
    return pillow("tiff", Image.fromarray(codes(values)), tiffinfo=directory)


def jpeg(values, index="R98", mode="RGB", space=65535, **options):
    """A JPEG with EXIF's ColorSpace, by default uncalibrated, and InteropIndex."""
    exif = Image.Exif()
    exif.get_ifd(0x8769).update({0xA001: space, 0xA005: {1: index}})
    image = Image.fromarray(codes(values)).convert(mode)
    return pillow("jpeg", image, exif=exif, quality=100, subsampling=0, **options)


def heic(values, **options):
    image = pillow_heif.from_bytes("RGB", (18, 12), codes(values).tobytes())
    return pillow("a.heic", image, quality=-1, chroma=444, matrix_coefficients=0, **options)


def gama(value):
    return struct.pack(">I", round(1e5 * value))


def chrm(values):
    return struct.pack(">8I", *np.rint(1e5 * np.array(values)).astype(int))


P3_PNG = stored(P3, srgb_encode)
IN_SPACES = {  # file, radiance, tolerance
    "ICC, parametric": (png(P3_PNG, iCCP=iccp(P3, SRGB_PARA)), WIDE, 5e-4),
    "ICC, table": (
        png(P3_PNG, iCCP=iccp(P3, curv(*codes(srgb_decode(np.linspace(0, 1, 4096)), np.uint16).tolist()))),
        WIDE,
        5e-4,
    ),
    "ICC, identity": (png(stored(P3, np.asarray), iCCP=iccp(P3, curv())), WIDE, 5e-4),
    "ICC, power, before EXIF": (jpeg(stored(ADOBE, adobe), icc_profile=icc(ADOBE, curv(563))), WIDE, 0.03),
    "ICC, its own cicp": (png(P3_PNG, iCCP=iccp(SRGB, curv(), cicp=b"cicp\0\0\0\0\x0c\x0d\0\1")), WIDE, 5e-5),
    "ICC, grey": (
        jpeg(GREY ** (256 / 460), mode="L", icc_profile=icc(SRGB, curv(460), model=b"GRAY", names=(b"kTRC",))),
        GREY,
        5e-3,
    ),
    "PNG, cICP of P3, before ICC": (png(P3_PNG, cICP=b"\x0c\x0d\0\1", iCCP=iccp(SRGB, curv())), WIDE, 5e-5),
    "PNG, cICP of BT.2020": (png(stored(REC2020, rec709), cICP=bytes([9, 14, 0, 1])), WIDE, 5e-5),
    "PNG, gAMA and cHRM": (
        png(stored(P3, lambda x: x**0.45455), gAMA=gama(0.45455), cHRM=chrm(P3_XY)),
        WIDE,
        5e-5,
    ),
    "PNG, gAMA 1": (png(stored(P3, np.asarray), gAMA=gama(1), cHRM=chrm(P3_XY)), WIDE, 5e-5),
    "PNG, cHRM alone": (png(P3_PNG, cHRM=chrm(P3_XY)), WIDE, 5e-5),
    "PNG, sRGB before gAMA": (
        png(srgb_encode(GREY), sRGB=b"\0", gAMA=gama(0.6), cHRM=chrm(ADOBE_XY)),
        GREY,
        5e-5,
    ),
    "PNG, another white": (png(GREY, gAMA=gama(1), cHRM=chrm((0.3457, 0.3585, *ADOBE_XY[2:]))), GREY, 5e-5),
    "TIFF's own tags": (
        tiff(
            stored(ADOBE, adobe),
            _301=3 * tuple(codes(np.linspace(0, 1, 256) ** GAMMA, np.uint16).tolist()),
            _318=ADOBE_XY[:2],
            _319=ADOBE_XY[2:],
        ),
        WIDE,
        0.01,
    ),
    "EXIF, R03": (jpeg(stored(ADOBE, adobe), "R03"), WIDE, 0.03),
    "EXIF, ColorSpace 2": (jpeg(stored(ADOBE, adobe), space=2), WIDE, 0.03),
    "HEIC, ICC": (heic(P3_PNG, icc_profile=icc(P3, SRGB_PARA)), WIDE, 0.01),
    "HEIC, nclx": (heic(P3_PNG, color_primaries=12, transfer_characteristics=13), WIDE, 0.01),
}
NO_COLOURS = {
    "HDR video, PQ": png(P3_PNG, cICP=bytes([9, 16, 0, 1])),
    "HDR video, HLG": png(P3_PNG, cICP=bytes([9, 18, 0, 1])),
    "cICP 9, 11, 0, 1": png(P3_PNG, cICP=bytes([9, 11, 0, 1])),
    "cICP 1, 13, 0, 0": png(P3_PNG, cICP=bytes([1, 13, 0, 0])),
    "for CMYK": jpeg(P3_PNG, icc_profile=icc(P3, curv(), model=b"CMYK")),
    "tables in place of curves": png(P3_PNG, iCCP=iccp(P3, names=())),
    "not readable as an ICC profile": png(P3_PNG, iCCP=iccp(P3, curv(1, 2, 3)[:14])),
    "unknown type": png(P3_PNG, iCCP=iccp(P3, b"parx" + para(0, 1.0)[4:])),
    "Singular matrix": png(P3_PNG, cHRM=chrm((0.3127, 0.329, *(0.3, 0.4) * 3))),
    "colours are CMYK": jpeg(P3_PNG, mode="CMYK"),
    "colours are CIELAB": tiff(P3_PNG, _262=8),
    "aspect 2": jpeg(P3_PNG, dpi=(144, 72)),
}


def write(folder, file):
    """Write a file of the table."""
    return sample.put(folder / file[0], file[1])


@pytest.mark.parametrize("case", IN_SPACES)
def test_a_photo_is_the_same_radiance_in_whatever_space_it_is_stored(tmp_path, case):
    file, radiance, tolerance = IN_SPACES[case]
    assert WIDE.min() < -0.1 and read_photo(write(tmp_path, file)).radiance == pytest.approx(radiance, abs=tolerance)


@pytest.mark.parametrize("fault", NO_COLOURS)
def test_colours_that_are_not_read_are_refused_by_name(tmp_path, fault):
    path = write(tmp_path, NO_COLOURS[fault])
    caught = refusal(fault, open_photo, path, "photos[0].image")
    assert caught.file == path and caught.key == "photos[0].image"


def test_float_codes_have_the_curve_of_their_profile(tmp_path):
    profile = np.frombuffer(icc(P3, para(0, 2.0)), np.uint8)
    path = save(tmp_path / "a.tif", stored(P3, np.sqrt).astype(np.float32), ICCProfile=profile)
    assert read_photo(path).radiance == pytest.approx(WIDE, abs=5e-4)


def test_a_given_encoding_replaces_the_curve_and_not_the_primaries(tmp_path):
    path = write(tmp_path, png(stored(P3, np.asarray), cICP=b"\x0c\x0d\0\1"))
    assert read_photo(path, "linear").radiance == pytest.approx(WIDE, abs=5e-5)


def test_every_channel_that_mixes_a_clipped_code_is_clipped(tmp_path):
    values = np.full((12, 18, 3), 0.5)
    values[2, 3, 0] = 1.0
    for primaries, expected in ((12, [True, True, True]), (1, [True, False, False])):
        clipped = read_photo(write(tmp_path, png(values, cICP=bytes([primaries, 13, 0, 1])))).clipped
        assert clipped[2, 3].tolist() == expected and clipped.any(axis=-1).sum() == 1


def test_exif_that_says_only_what_it_is_not_is_taken_for_srgb_with_a_warning(tmp_path, caplog):
    assert read_photo(write(tmp_path, jpeg(srgb_encode(GREY)))).radiance == pytest.approx(GREY, abs=0.02)
    assert "EXIF says that it is not sRGB" in caplog.text
