"""Colour spaces of photos: a curve of each channel from codes to linear values, and a matrix to linear Rec. 709.

A file states the meaning of its codes in one of these ways; the first that it has counts.

CICP          PNG's chunk cICP and HEIF's nclx (after an ICC profile): code points of ITU-T H.273
ICC profile   curves `curv` and `para`, and colorants (ICC.1:2022, 10.6, 10.18, 10.31); tables of colours are refused
PNG           sRGB; else gAMA and cHRM
TIFF          TransferFunction, PrimaryChromaticities and WhitePoint
EXIF          InteropIndex R03 is Adobe RGB (1998), by DCF 2.0

Otherwise integers are sRGB-encoded, floats are linear, and the primaries are those of Rec. 709. White becomes white:
it is adapted by Bradford's method, as in ICC profiles. Colours beyond Rec. 709 have negative values.
"""

import logging
import struct
import warnings
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from jaxtyping import Bool, Float, Shaped
from PIL import Image
from PIL.ExifTags import IFD, Base, Interop

from factorlib.images.exif import DAMAGED, load_tags
from factorlib.images.tone import DECODERS, Curve, Values, power_decode, srgb_decode
from factorlib.reading import reading

D65 = (0.3127, 0.329)
REC709 = np.array([[0.64, 0.33], [0.3, 0.6], [0.15, 0.06], D65])  # red, green, blue, white: x, y
ADOBE_RGB = np.array([[0.64, 0.33], [0.21, 0.71], [0.15, 0.06], D65])
D50 = np.array([0.9642, 1.0, 0.8249])  # XYZ of the white of ICC's connection space
BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
LEAST_MIXED = 1e-3  # least part of a channel that belongs to another one
LARGEST_GAIN = 100.0  # greatest factor between primaries; damaged ones have more
EXPORT = "export it again as sRGB, of 8 or 16 bits, or as a linear EXR"
CURVES = {"RGB": (b"rTRC", b"gTRC", b"bTRC"), "GRAY": (b"kTRC",) * 3}  # tags of an ICC profile, by its colours
COLORANTS = {"RGB": (b"rXYZ", b"gXYZ", b"bXYZ"), "GRAY": ()}
EXIF_SRGB = 1  # value of EXIF's ColorSpace
Image.MAX_IMAGE_PIXELS = None  # of a photo or mask, whose size `check_pixels` limits
log = logging.getLogger("factorlib.images")


def rec709_decode(code: Values) -> Values:
    """Convert values of the camera curve of BT.709 to linear ones.

    >>> rec709_decode(np.array([0.0, 0.081, 0.5, 1.0])).round(4).tolist()
    [0.0, 0.0179, 0.2596, 1.0]
    """
    size = np.abs(code)
    return np.copysign(np.where(size < 0.081, size / 4.5, ((size + 0.099) / 1.099) ** (1 / 0.45)), code)


# code points of ITU-T H.273: primaries and transfer characteristics
UNSPECIFIED = 2
PRIMARIES = {
    **dict.fromkeys((1, UNSPECIFIED), REC709),
    4: np.array([[0.67, 0.33], [0.21, 0.71], [0.14, 0.08], [0.31, 0.316]]),
    5: np.array([[0.64, 0.33], [0.29, 0.6], [0.15, 0.06], D65]),
    **dict.fromkeys((6, 7), np.array([[0.63, 0.34], [0.31, 0.595], [0.155, 0.07], D65])),
    9: np.array([[0.708, 0.292], [0.17, 0.797], [0.131, 0.046], D65]),
    11: np.array([[0.68, 0.32], [0.265, 0.69], [0.15, 0.06], [0.314, 0.351]]),
    12: np.array([[0.68, 0.32], [0.265, 0.69], [0.15, 0.06], D65]),
}
TRANSFERS: dict[int, Curve] = {
    **dict.fromkeys((1, 6, 14, 15), rec709_decode),
    **dict.fromkeys((UNSPECIFIED, 13), srgb_decode),
    4: power_decode(2.2),
    5: power_decode(2.8),
    8: np.asarray,
}
VIDEO = {16: "PQ", 18: "HLG"}  # transfer characteristics of HDR video


class ColourSpace(msgspec.Struct, frozen=True):
    """Meaning of the codes of a photo.

    curves      curve of each channel, from codes in units of white to linear values
    to_rec709   matrix from linear values to linear Rec. 709; None if they are that
    """

    curves: tuple[Curve, Curve, Curve]
    to_rec709: Float[np.ndarray, "3 3"] | None = None

    @property
    def encoding(self) -> str:
        """Name of the curves: "srgb", "linear", "gamma2.2", or "profile" for others."""
        named = (name for name, curve in DECODERS.items() if self.curves == (curve, curve, curve))
        return next(named, "profile")

    def linear(self, codes: Shaped[np.ndarray, "r w 3"], white: int | None) -> Float[np.ndarray, "r w 3"]:
        """Decode codes to linear Rec. 709: computed for floats and wide codes, looked up for codes of up to 16 bits.

        Args:
            codes: Codes.
            white: Code of 1; None for floats.
        """
        with np.errstate(over="ignore", invalid="ignore"):
            if white is None or white >= 2**16:
                values = self._decode(codes.astype(np.float32) if white is None else codes / white).astype(np.float32)
            else:
                levels = np.repeat(np.arange(white + 1)[:, None] / white, 3, axis=1)
                values = self._decode(levels).astype(np.float32)[codes, np.arange(3)]
            return values if self.to_rec709 is None else values @ self.to_rec709.T.astype(np.float32)

    def clipped(self, codes: Bool[np.ndarray, "r w 3"]) -> Bool[np.ndarray, "r w 3"]:
        """Return the mask of channels of Rec. 709 that a clipped code is mixed into."""
        if self.to_rec709 is None:
            return codes
        return (codes[..., None, :] & (np.abs(self.to_rec709) > LEAST_MIXED)).any(axis=-1)

    def _decode(self, values: Shaped[np.ndarray, "*batch 3"]) -> Values:
        return np.stack([curve(values[..., k]) for k, curve in enumerate(self.curves)], axis=-1)


SRGB = ColourSpace((srgb_decode,) * 3)
LINEAR = ColourSpace((np.asarray,) * 3)


def colour_space(
    path: str | Path, attributes: Mapping[str, Any], default: ColourSpace, key: str | None = None
) -> ColourSpace:
    """Return the colour space that a JPEG, PNG or TIFF states, with a warning where it says only that it is not sRGB.

    Args:
        path: File.
        attributes: Attributes of the file by OpenImageIO's names.
        default: Space of a file that states none.
        key: Key to name in errors.

    Raises:
        InputError: If the space is not one of curves and primaries.
    """
    with reading("a picture of known colours", path, key, EXPORT):
        if "CICP" in attributes:
            return cicp_space(*attributes["CICP"])
        if "ICCProfile" in attributes:
            with reading("an ICC profile", path, key, EXPORT):
                return icc_space(bytes(attributes["ICCProfile"]))
        info: Mapping[Any, Any] = {}
        exif = load_tags(path)
        with suppress(*DAMAGED), warnings.catch_warnings(action="ignore"), Image.open(path) as image:
            info = image.info
            if not exif and image.format != "PNG":  # which would be decoded whole
                exif = image.getexif()
        if "gamma" in info or "chromaticity" in info:
            return default if "srgb" in info else _png_space(info)
        if {Base.TransferFunction, Base.PrimaryChromaticities}.intersection(exif):
            return _tiff_space(exif, default)
        named = exif.get_ifd(IFD.Exif).get(Base.ColorSpace, EXIF_SRGB)
        index = str(exif.get_ifd(IFD.Interop).get(Interop.InteropIndex, ""))
        if index.startswith("R03") or named == 2:  # which some programs write, though the standard has no 2
            return ColourSpace((power_decode(563 / 256),) * 3, to_rec709(ADOBE_RGB))
        if named != EXIF_SRGB:
            log.warning("%s: EXIF says that it is not sRGB, and no profile says what it is: taken for sRGB", path)
    return default


def cicp_space(primaries: int, transfer: int, matrix: int = 0, full_range: int = 1) -> ColourSpace:
    """Return the colour space of code points of ITU-T H.273.

    Raises:
        ValueError: If the curve is one of HDR video, or a code point is reserved or not read.
    """
    if transfer in VIDEO:
        raise ValueError(f"it is encoded for HDR video, {VIDEO[transfer]}")
    if transfer not in TRANSFERS or primaries not in PRIMARIES or not full_range:
        raise ValueError(f"its cICP {primaries}, {transfer}, {matrix}, {full_range} is not read")
    return ColourSpace((TRANSFERS[transfer],) * 3, to_rec709(PRIMARIES[primaries]))


def icc_space(profile: bytes) -> ColourSpace:
    """Return the colour space of an ICC profile of curves: RGB with colorants, or grey.

    Raises:
        ValueError: If it is damaged, of other colours, or made of tables.
    """
    count = struct.unpack_from(">I", profile, 128)[0]
    places = struct.iter_unpack(">4sII", profile[132 : 132 + 12 * count])
    tags = {name: profile[start : start + size] for name, start, size in places}
    model = profile[16:20].decode("latin-1").strip()
    if b"cicp" in tags:
        return cicp_space(*tags[b"cicp"][8:12])
    if model not in CURVES:
        raise ValueError(f"it is for {model}, not for RGB or grey")
    if profile[20:24] != b"XYZ " or not tags.keys() >= {*CURVES[model], *COLORANTS[model]}:
        raise ValueError("it has tables in place of curves")
    red, green, blue = (_icc_curve(tags[name]) for name in CURVES[model])
    colorants = [np.frombuffer(tags[name], ">i4", 3, 8) / 2**16 for name in COLORANTS[model]]
    matrix = np.linalg.solve(_d50_from_rgb(REC709), np.transpose(colorants)) if colorants else np.eye(3)
    return ColourSpace((red, green, blue), _unless_identity(matrix))


def _icc_curve(tag: bytes) -> Curve:
    """Return the curve of a tag of type `curv` (a power or a table) or `para`, with codes beyond [0, 1] continued."""
    if tag[:4] == b"curv":
        count = struct.unpack_from(">I", tag, 8)[0]
        if count == 1:
            return power_decode(struct.unpack_from(">H", tag, 12)[0] / 256)
        return _table(np.frombuffer(tag, ">u2", count, 12)) if count else np.asarray
    kind = struct.unpack_from(">H", tag, 8)[0]
    if tag[:4] != b"para" or kind > 4:
        raise ValueError("a curve is of an unknown type")
    given = np.frombuffer(tag, ">i4", (1, 3, 4, 5, 7)[kind], 12) / 2**16
    g, a, b, c, d, e, f = np.append(given, (1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0)[len(given) :])
    if kind in (1, 2):
        c, d, e, f = 0.0, -b / a, c, c
    return lambda code: np.where(code >= d, np.maximum(a * code + b, 0) ** g + e, c * code + f)


def _table(values: Shaped[np.ndarray, " n"]) -> Curve:
    """Return the curve through 16-bit values at equal distances from 0 to 1, continued by its last slopes."""
    from scipy.interpolate import make_interp_spline  # imported here, since it takes a third of a second

    return make_interp_spline(np.linspace(0, 1, len(values)), values / (2**16 - 1), k=1)


def _png_space(info: Mapping[Any, Any]) -> ColourSpace:
    """Return the space of PNG's gAMA, the exponent of encoding, and cHRM: white, red, green, blue."""
    curve = power_decode(1 / info["gamma"]) if info.get("gamma", 0) > 0 else srgb_decode
    white, *primaries = np.reshape(info.get("chromaticity", np.roll(REC709, 1, axis=0)), (4, 2))
    return ColourSpace((np.asarray if info.get("gamma") == 1 else curve,) * 3, to_rec709(np.array([*primaries, white])))


def _tiff_space(exif: Image.Exif, default: ColourSpace) -> ColourSpace:
    """Return the space of TIFF's TransferFunction (one table, or one a channel), PrimaryChromaticities, WhitePoint."""
    curves = default.curves
    if values := exif.get(Base.TransferFunction):
        channels = 3 if len(values) % 3 == 0 else 1
        red, *others = (_table(table) for table in np.reshape(values, (channels, -1)))
        curves = (red, *(others or (red, red)))
    primaries = exif.get(Base.PrimaryChromaticities, REC709[:3])
    return ColourSpace(
        curves, to_rec709(np.append(primaries, exif.get(Base.WhitePoint, D65)).astype(float).reshape(4, 2))
    )


def to_rec709(primaries: Float[np.ndarray, "4 2"], adapted: bool = True) -> Float[np.ndarray, "3 3"] | None:
    """Return the matrix from linear values of some primaries to Rec. 709; None where it changes nothing.

    Args:
        primaries: Chromaticities, which need not be colours: ACES' blue has a negative y. All 0 are unknown ones.
        adapted: True if white becomes white, False if it keeps its chromaticity.

    Raises:
        ValueError: If they span no colours.
    """
    convert = _d50_from_rgb if adapted else _xyz_from_rgb
    return _unless_identity(np.linalg.inv(convert(REC709)) @ convert(primaries)) if primaries.any() else None


def _unless_identity(matrix: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"] | None:
    """Return a matrix between primaries; None for the identity."""
    if not np.abs(matrix).max() < LARGEST_GAIN:
        raise ValueError("its primaries span no colours")
    return None if np.abs(matrix - np.eye(3)).max() < LEAST_MIXED else matrix


def _xyz_from_rgb(primaries: Float[np.ndarray, "4 2"]) -> Float[np.ndarray, "3 3"]:
    """Return the matrix of primaries whose sum is white of luminance 1."""
    x, y = primaries.T
    xyz = np.stack([x, y, 1 - x - y])
    return xyz[:, :3] * np.linalg.solve(xyz[:, :3], xyz[:, 3] / y[3])


def _d50_from_rgb(primaries: Float[np.ndarray, "4 2"]) -> Float[np.ndarray, "3 3"]:
    """Return the same matrix with white adapted to D50 by Bradford's method (ICC.1:2022, annex E)."""
    xyz = _xyz_from_rgb(primaries)
    gains = (BRADFORD @ D50) / (BRADFORD @ xyz.sum(axis=1))
    return np.linalg.solve(BRADFORD, gains[:, None] * (BRADFORD @ xyz))
