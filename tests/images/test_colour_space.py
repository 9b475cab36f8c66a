"""Colours of photos: a file is the same radiance in whatever space it is stored, or is refused by name."""

import io
import struct
import zlib
from itertools import accumulate

import numpy as np
import pillow_heif
import pytest
from PIL import Image
from PIL.TiffImagePlugin import ImageFileDirectory_v2

from factorlib.images.photo import open_photo, read_photo
from factorlib.images.tone import srgb_decode, srgb_encode
from tests.faults import sample
from tests.images.test_photo import codes, save
from tests.refusal import refusal

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
READ = {  # file, radiance, tolerance
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
REFUSED = {
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


@pytest.mark.parametrize("case", READ)
def test_a_photo_is_the_same_radiance_in_whatever_space_it_is_stored(tmp_path, case):
    file, radiance, tolerance = READ[case]
    assert WIDE.min() < -0.1 and read_photo(write(tmp_path, file)).radiance == pytest.approx(radiance, abs=tolerance)


@pytest.mark.parametrize("fault", REFUSED)
def test_colours_that_are_not_read_are_refused_by_name(tmp_path, fault):
    path = write(tmp_path, REFUSED[fault])
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
