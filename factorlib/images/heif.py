"""Reader of HEIF photos (HEIC), as phones take them, by pillow-heif: 8, 10 or 12 bits, the primary picture of the file.

In HEIF, orientation is a property of the picture (`irot`, `imir`), which the decoder applies. EXIF's orientation must
not be applied again. The picture is decoded at once, in its own codes: 96 MB for 48 megapixels of 8 bits grey, 288 MB
of 10 bits RGB.
"""

import io
from contextlib import suppress
from functools import cache
from pathlib import Path

import numpy as np
from jaxtyping import Shaped
from PIL import ImageCms

from factorlib.errors import InputError
from factorlib.images.exif import read_exif
from factorlib.images.scanlines import COPY, OpenPhoto

BRANDS = {b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1", b"mif2"}
VIDEO = {16: "PQ", 18: "HLG"}  # transfer characteristics of ITU-T H.273 for HDR video
SIZES = ("Exif:PixelXDimension", "Exif:PixelYDimension")
FAILURES = (ValueError, EOFError, SyntaxError, RuntimeError, OSError)  # exceptions of pillow-heif for damaged files


def is_heif(path: str | Path) -> bool:
    """Return whether the file begins with a box `ftyp` of a HEIF brand."""
    try:
        with Path(path).open("rb") as stream:
            head = stream.read(12)
    except OSError:
        return False
    return head[4:8] == b"ftyp" and head[8:12] in BRANDS


def open_heif(path: str | Path, key: str | None) -> OpenPhoto:
    """Open a HEIF photo; InputError if it cannot be decoded, or has a transfer function of HDR video."""

    def refused(fault: str, cure: str) -> InputError:
        """Return an InputError for this file."""
        return InputError(fault, file=path, key=key, cure=cure)

    convert = f"convert it: magick {Path(path).name} {Path(path).stem}.png"
    import pillow_heif

    try:
        file = pillow_heif.open_heif(path, convert_hdr_to_8bit=False, hdr_to_16bit=False)
        picture = file[file.primary_index]
    except FAILURES as error:
        raise refused(f"not readable as HEIF ({error})", convert) from None
    info = picture.info
    width, height = picture.size
    curve = VIDEO.get((info.get("nclx_profile") or {}).get("transfer_characteristics", 0))
    if curve:
        raise refused(
            f"is encoded for HDR video ({curve}), not as sRGB", "export it from the phone as a JPEG, or without HDR"
        )

    @cache
    def pixels() -> Shaped[np.ndarray, "h w 3"]:
        """Decode RGB codes without alpha; grey is repeated by broadcasting, not in memory."""
        try:
            codes = np.asarray(picture)
        except FAILURES as error:
            raise refused(f"truncated or damaged ({error})", COPY) from None
        if codes.shape[:2] != (height, width):
            sizes = f"{codes.shape[1]}×{codes.shape[0]} pixels instead of the {width}×{height} of its header"
            raise refused(f"truncated or damaged ({sizes})", COPY)
        codes = codes[..., None] if codes.ndim == 2 else codes
        return codes[..., :3] if codes.shape[2] >= 3 else np.broadcast_to(codes[..., :1], (height, width, 3))

    return OpenPhoto(
        width=width,
        height=height,
        exif=_upright_exif(info.get("exif"), width > height),
        profile=_profile_name(info.get("icc_profile")),
        white=2 ** info["bit_depth"] - 1,
        encoding="srgb",
        rows=lambda begin, end: pixels()[begin:end],
    )


def _upright_exif(block: bytes | None, is_wide: bool) -> dict[str, float | int]:
    """Return the tags of an EXIF block; its size, which is that before rotation, is turned to match the picture."""
    exif = read_exif(block)
    across, down = (exif.get(name) for name in SIZES)
    if across and down and (across > down) != is_wide:
        exif |= dict(zip(SIZES, (down, across)))
    return exif


def _profile_name(profile: bytes | None) -> str:
    """Return the name of an ICC profile, "" for a damaged one or none."""
    with suppress(OSError, ImageCms.PyCMSError):
        if profile:
            return ImageCms.getProfileDescription(ImageCms.ImageCmsProfile(io.BytesIO(profile))).strip()
    return ""
