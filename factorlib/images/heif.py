"""HEIF photos (HEIC), as phones take them, by pillow-heif: 8, 10 or 12 bits, the primary picture of the file.

Orientation is a property of the picture in HEIF (`irot`, `imir`), which the decoder applies; what EXIF says beside it must not
be applied again.  The picture is decoded at once, in its own codes: 96 MB for 48 megapixels of 8 bits grey, 288 MB of 10 bits RGB.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Shaped
from PIL import ImageCms

from factorlib.errors import InputError
from factorlib.images.exif import exif_of_bytes
from factorlib.images.stored import Stored

BRANDS = {b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1", b"mif2"}
VIDEO = {16: "PQ", 18: "HLG"}  # transfer characteristics of ITU-T H.273 that are no sRGB
SIZES = ("Exif:PixelXDimension", "Exif:PixelYDimension")
CONVERT = "convert it: magick {0} {1}.png"


def is_heif(path: str | Path) -> bool:
    """By the file's first bytes: a box `ftyp` with a brand of HEIF's."""
    try:
        with Path(path).open("rb") as stream:
            head = stream.read(12)
    except OSError:
        return False
    return head[4:8] == b"ftyp" and head[8:12] in BRANDS


def open_heif(path: str | Path, key: str | None) -> Stored:
    """Raises InputError for a file that cannot be decoded, and for one in a transfer function of HDR video."""
    picture = _opened(path, key)
    info, (width, height) = picture.info, picture.size
    _refuse_video(info, path, key)
    cached: list[np.ndarray] = []

    def rows(begin: int, end: int) -> Shaped[np.ndarray, "r w 3"]:
        """Rows begin … end − 1; the picture is decoded for the first of them."""
        if not cached:
            cached.append(_decoded(picture, path, key))
        return cached[0][begin:end]

    return Stored(
        width=width,
        height=height,
        orientation=1,
        exif=_upright(exif_of_bytes(info.get("exif")), width, height),
        profile=_profile(info.get("icc_profile")),
        white=2 ** info["bit_depth"] - 1,
        encoding="srgb",
        rows=rows,
    )


def _opened(path: str | Path, key: str | None) -> Any:
    try:
        import pillow_heif
    except ImportError as error:
        raise _refused(f"HEIF is read by pillow-heif, which cannot be imported ({error})", path, key) from None
    try:
        file = pillow_heif.open_heif(path, convert_hdr_to_8bit=False, hdr_to_16bit=False)
        return file[file.primary_index]
    except (ValueError, EOFError, SyntaxError, RuntimeError, OSError) as error:
        raise _refused(f"not readable as HEIF ({error})", path, key) from None


def _decoded(picture: Any, path: str | Path, key: str | None) -> Shaped[np.ndarray, "h w 3"]:
    """RGB codes, alpha dropped; grey is repeated where it is looked at, not in memory."""
    width, height = picture.size  # as the header says; decoding may find another, and the picture then takes that one
    try:
        pixels = np.asarray(picture)
    except (ValueError, EOFError, SyntaxError, RuntimeError, OSError) as error:
        raise _damaged(str(error), path, key) from None
    if pixels.shape[:2] != (height, width):
        found = f"its header says {width}×{height} pixels, the picture in it has {pixels.shape[1]}×{pixels.shape[0]}"
        raise _damaged(found, path, key)
    if pixels.ndim == 2:
        pixels = pixels[..., None]
    return pixels[..., :3] if pixels.shape[2] >= 3 else np.broadcast_to(pixels[..., :1], (*pixels.shape[:2], 3))


def _upright(exif: dict[str, float | int], width: int, height: int) -> dict[str, float | int]:
    """With the sizes that the camera wrote, which are of the picture before it was turned, as those of a picture lying like this one."""
    across, down = (exif.get(name) for name in SIZES)
    if across is None or down is None or (across > down) == (width > height):
        return exif
    return exif | dict(zip(SIZES, (down, across)))


def _refuse_video(info: dict[str, Any], path: str | Path, key: str | None) -> None:
    curve = VIDEO.get((info.get("nclx_profile") or {}).get("transfer_characteristics"))
    if curve:
        found = f"is encoded for HDR video ({curve}), not as sRGB"
        raise InputError(found, file=path, key=key, cure="export it from the phone as a JPEG, or without HDR")


def _profile(icc: bytes | None) -> str:
    try:
        return ImageCms.getProfileDescription(ImageCms.ImageCmsProfile(io.BytesIO(icc))).strip() if icc else ""
    except (OSError, ImageCms.PyCMSError):
        return ""


def _damaged(found: str, path: str | Path, key: str | None) -> InputError:
    return InputError(f"truncated or damaged ({found})", file=path, key=key, cure="copy it again from where it came")


def _refused(found: str, path: str | Path, key: str | None) -> InputError:
    return InputError(found, file=path, key=key, cure=CONVERT.format(Path(path).name, Path(path).stem))
