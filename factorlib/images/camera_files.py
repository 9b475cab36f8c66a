"""Readers of photos that a library decodes at once: HEIF (HEIC) by pillow-heif, raw photos by LibRaw.

HEIF, as phones take it, has 8, 10 or 12 bits; the primary picture of the file is read. Orientation is a property of the
picture (`irot`, `imir`), which the decoder applies. EXIF's orientation must not be applied again. The picture is kept
in its own codes: 96 MB for 48 megapixels of 8 bits grey, 288 MB of 10 bits RGB.

Raw photos (DNG and cameras' formats) are developed to linear values with the camera's white balance, Rec. 709, without
automatic brightness: about 800 MB for 48 megapixels. Red, green and blue of the result are mixed from those of the
sensor, each of which is interpolated from the pixels around. If one of these has reached the sensor's white level, all
three channels of the result are clipped. The picture is cropped as the file specifies (DNG's DefaultCrop), as other
programs show it.
"""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Shaped
from scipy.ndimage import maximum_filter

from factorlib.dataset.schema import RAW
from factorlib.errors import InputError
from factorlib.images.colour_space import LINEAR, SRGB, UNSPECIFIED, VIDEO, colour_space
from factorlib.images.exif import read_exif
from factorlib.images.scanlines import CLIPPED, COPY, OpenPhoto

BRANDS = {b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1", b"mif2"}
SIZES = ("Exif:PixelXDimension", "Exif:PixelYDimension")
FAILURES = (ValueError, EOFError, SyntaxError, RuntimeError, OSError)  # exceptions of pillow-heif for damaged files
ORIENTATION = {0: 1, 3: 3, 5: 8, 6: 6}  # EXIF's orientation for LibRaw's `flip`
AROUND = 5  # side of the square from which demosaicing interpolates a pixel
WHITE = 2**16 - 1
TAGS = {  # LibRaw's names, for files other than TIFF
    "ExposureTime": "shutter_speed",
    "FNumber": "aperture",
    "Exif:PhotographicSensitivity": "iso_speed",
    "Exif:FocalLength": "focal_length",
}


def is_heif(path: str | Path) -> bool:
    """Return whether the file begins with a box `ftyp` of a HEIF brand."""
    with suppress(OSError), Path(path).open("rb") as stream:
        head = stream.read(12)
        return head[4:8] == b"ftyp" and head[8:12] in BRANDS
    return False


def open_heif(path: str | Path, key: str | None) -> OpenPhoto:
    """Open a HEIF photo; InputError if it cannot be decoded, or has a transfer function of HDR video."""

    def refusal(fault: str, cure: str) -> InputError:
        """Return an InputError for this file."""
        return InputError(fault, file=path, key=key, cure=cure)

    convert = f"convert it: magick {Path(path).name} {Path(path).stem}.png"
    import pillow_heif

    try:
        file = pillow_heif.open_heif(path, convert_hdr_to_8bit=False, hdr_to_16bit=False)
        picture = file[file.primary_index]
    except FAILURES as error:
        raise refusal(f"not readable as HEIF ({error})", convert) from None
    info = picture.info
    width, height = picture.size
    nclx = info.get("nclx_profile") or {}
    points = [nclx.get(name, UNSPECIFIED) for name in ("color_primaries", "transfer_characteristics")]
    profile = info.get("icc_profile")
    stated = {"ICCProfile": profile} if profile and points[1] not in VIDEO else {"CICP": points}

    @cache
    def pixels() -> Shaped[np.ndarray, "h w 3"]:
        """Decode RGB codes without alpha; grey is repeated by broadcasting, not in memory."""
        try:
            codes = np.asarray(picture)
        except FAILURES as error:
            raise refusal(f"truncated or damaged ({error})", COPY) from None
        if codes.shape[:2] != (height, width):
            sizes = f"{codes.shape[1]}×{codes.shape[0]} pixels instead of the {width}×{height} of its header"
            raise refusal(f"truncated or damaged ({sizes})", COPY)
        codes = codes[..., None] if codes.ndim == 2 else codes
        return codes[..., :3] if codes.shape[2] >= 3 else np.broadcast_to(codes[..., :1], (height, width, 3))

    return OpenPhoto(
        width=width,
        height=height,
        exif=_upright_exif(info.get("exif"), width > height),
        white=2 ** info["bit_depth"] - 1,
        space=colour_space(path, stated, SRGB, key),
        rows=lambda begin, end: pixels()[begin:end],
    )


def _upright_exif(block: bytes | None, is_wide: bool) -> dict[str, float | int]:
    """Return the tags of an EXIF block; its size, which is that before rotation, is turned to match the picture."""
    exif = read_exif(block)
    across, down = (exif.get(name) for name in SIZES)
    if across and down and (across > down) != is_wide:
        exif |= dict(zip(SIZES, (down, across)))
    return exif


def is_raw(path: str | Path) -> bool:
    """Return whether the suffix is that of a raw file, or the file is a DNG, whose first picture is only a preview."""
    return Path(path).suffix.lower() in RAW or "DNG" in read_exif(path)


def open_raw(path: str | Path, key: str | None) -> OpenPhoto:
    """Open a raw photo; InputError if LibRaw cannot read the file."""
    import rawpy

    with _refused("not readable as a raw photo", path, key):
        sensor = rawpy.imread(str(path))
        sizes = sensor.sizes
        settings = sensor.other
    rows, columns = _crop(sizes)

    @cache
    def develop() -> tuple[np.ndarray, np.ndarray]:
        """Return 16-bit linear codes, not rotated, and a mask of saturated pixels."""
        with sensor, _refused("cannot be developed", path, key):
            pixels = sensor.postprocess(
                output_bps=16,
                gamma=(1, 1),
                no_auto_bright=True,
                use_camera_wb=True,
                output_color=rawpy.ColorSpace.sRGB,
                adjust_maximum_thr=0.0,
                user_flip=0,
            )
            return pixels[rows, columns], _saturation_mask(sensor)[rows, columns]

    def unpack() -> None:
        """Read the sensor's pixels."""
        with _refused("cannot be developed", path, key):
            sensor.raw_image  # noqa: B018

    return OpenPhoto(
        width=columns.stop - columns.start,
        height=rows.stop - rows.start,
        orientation=ORIENTATION.get(sizes.flip, 1),
        exif={tag: getattr(settings, name) for tag, name in TAGS.items()} | read_exif(path),
        white=WHITE,
        space=LINEAR,
        rows=lambda begin, end: develop()[0][begin:end],
        saturated=lambda begin, end: np.repeat(develop()[1][begin:end, :, None], 3, axis=2),
        unpack=unpack,
    )


@contextmanager
def _refused(fault: str, path: str | Path, key: str | None) -> Iterator[None]:
    """Raise LibRaw's errors as an InputError with its words and the command that develops the photo."""
    import rawpy

    try:
        yield
    except rawpy.LibRawError as error:
        text = error.args[0] if error.args else error
        reason = text.decode("utf-8", "replace") if isinstance(text, bytes) else str(text)
        raise InputError(
            f"{fault} ({reason})",
            file=path,
            key=key,
            cure=f"develop it: darktable-cli {Path(path).name} {Path(path).stem}.tif",
        ) from None


def _crop(sizes: Any) -> tuple[slice, slice]:
    """Return rows and columns of the crop that the file specifies, in developed pixels; else of the whole picture."""
    top = sizes.crop_top_margin - sizes.top_margin
    left = sizes.crop_left_margin - sizes.left_margin
    bottom = top + sizes.crop_height
    right = left + sizes.crop_width
    if 0 <= top < bottom <= sizes.iheight and 0 <= left < right <= sizes.iwidth:
        return slice(top, bottom), slice(left, right)
    return slice(0, sizes.iheight), slice(0, sizes.iwidth)


def _saturation_mask(sensor: Any) -> Bool[np.ndarray, "h w"]:
    """Return a mask of developed pixels for which some contributing sensor pixel has reached the white level.

    The sensor's white level is the top code of its least amplified channel.
    """
    levels = [level for level in (sensor.camera_white_level_per_channel or []) if level > 0]
    full = sensor.raw_image_visible >= CLIPPED * min([sensor.white_level, *levels])
    return np.logical_or.reduce(full, axis=2) if full.ndim == 3 else maximum_filter(full, size=AROUND)
