"""Reading a photo: linear radiance, which channels are clipped, which pixels are numbers, and the focal length.

Orientation   as displayed: the EXIF orientation is applied.
Encoding      8- and 16-bit files are sRGB-encoded, float files linear, unless `encoding` says otherwise; primaries
              are taken for Rec. 709.
Channels      one is grey; alpha is dropped.  Integer colours are taken as stored, without the alpha multiplied in;
              float colours (EXR) are premultiplied by convention and are taken so.
Clipped       integer codes from CLIPPED of the range (254 of 255) on: JPEG compression ripples the top code a little.
              A float file has no top code; what is not finite in it is no pixel.
"""

from __future__ import annotations

import logging
from pathlib import Path

import msgspec
import numpy as np
import OpenImageIO as oiio
from jaxtyping import Bool, Float

from factorlib.errors import InputError
from factorlib.images.focal import focal_px_of_exif
from factorlib.images.transfer import decoder

CLIPPED = 0.995
ORIENTATIONS = range(1, 9)
log = logging.getLogger("factorlib.images")


class Photo(msgspec.Struct, frozen=True):
    """radiance: linear Rec. 709, scene-referred up to exposure, 0 where not finite; clipped: at the top code or above;
    finite: all three channels are numbers; focal_px: from EXIF, of the photo as displayed; encoding: the one used."""

    radiance: Float[np.ndarray, "h w 3"]
    clipped: Bool[np.ndarray, "h w 3"]
    finite: Bool[np.ndarray, "h w"]
    focal_px: float | None
    width: int
    height: int
    encoding: str


def read_photo(path: str | Path, encoding: str | None = None, key: str | None = None) -> Photo:
    """The photo at `path` (JPEG, PNG, TIFF, EXR, HDR) as displayed.

    encoding: srgb, linear or gamma2.2; None takes what the kind of file implies.
    key: where the photo is named, for messages.
    Raises InputError for a file that is unreadable, truncated, or holds no grey or RGB.
    """
    spec, stored = _read_pixels(path, key)
    rgb = _oriented(_rgb(stored, spec, path, key), spec.get_int_attribute("Orientation", 1))
    integer = rgb.dtype.kind == "u"
    encoding = encoding or ("srgb" if integer else "linear")
    radiance = (_decoded_codes if integer else _decoded_floats)(rgb, encoding)
    finite = np.isfinite(radiance).all(axis=-1)
    _warn_of_profile(spec, path)
    return Photo(
        radiance=np.where(finite[..., None], radiance, np.float32(0)),
        clipped=rgb >= CLIPPED * np.iinfo(rgb.dtype).max if integer else np.zeros(rgb.shape, dtype=bool),
        finite=finite,
        focal_px=focal_px_of_exif({a.name: a.value for a in spec.extra_attribs}, spec.width, spec.height, path),
        width=rgb.shape[1],
        height=rgb.shape[0],
        encoding=encoding,
    )


def _read_pixels(path: str | Path, key: str | None) -> tuple[oiio.ImageSpec, np.ndarray]:
    """Header and pixels [h, w, c] as stored, in the file's own type, alpha not multiplied in."""
    wish = oiio.ImageSpec()
    wish.attribute("oiio:UnassociatedAlpha", 1)
    source = oiio.ImageInput.open(str(path), wish)
    if source is None:
        found = f"not readable as an image ({_line(oiio.geterror())})"
        raise InputError(found, file=path, key=key, cure="is it whole, and of the kind its suffix says?")
    spec = source.spec()
    pixels = source.read_image(spec.format)
    error = _line(source.geterror())
    source.close()
    if pixels is None or "Premature end" in error:
        raise InputError(f"truncated or damaged ({error})", file=path, key=key, cure="copy it again from where it came")
    if error:
        log.warning("%s: %s", path, error)
    return spec, pixels.reshape(spec.height, spec.width, spec.nchannels)


def _line(text: str) -> str:
    return " ".join(text.split())


def _rgb(pixels: np.ndarray, spec: oiio.ImageSpec, path: str | Path, key: str | None) -> np.ndarray:
    """The colour channels, grey repeated."""
    names = list(spec.channelnames)
    if set("RGB") <= set(names):
        return pixels[..., [names.index(name) for name in "RGB"]]
    colours = [index for index in range(len(names)) if index != spec.alpha_channel and names[index] != "Z"]
    if len(colours) != 1:
        raise InputError(f"has the channels {', '.join(names)}", file=path, key=key, cure="save it as RGB or grey, in one layer")
    return np.repeat(pixels[..., colours], 3, axis=-1)


def _oriented(pixels: np.ndarray, orientation: int) -> np.ndarray:
    """Turned as EXIF says: 1 as is, 2-4 mirrored or half turned, 5-8 with rows and columns swapped."""
    if orientation not in ORIENTATIONS:
        return pixels
    turned = pixels.swapaxes(0, 1) if orientation >= 5 else pixels
    rows, columns = -1 if orientation in (3, 4, 7, 8) else 1, -1 if orientation in (2, 3, 6, 7) else 1
    return np.ascontiguousarray(turned[::rows, ::columns])


def _decoded_codes(codes: np.ndarray, encoding: str) -> Float[np.ndarray, "h w 3"]:
    if codes.dtype.itemsize > 2:
        return decoder(encoding)(codes / np.iinfo(codes.dtype).max).astype(np.float32)
    top = np.iinfo(codes.dtype).max
    return decoder(encoding)(np.arange(top + 1) / top).astype(np.float32)[codes]


def _decoded_floats(values: np.ndarray, encoding: str) -> Float[np.ndarray, "h w 3"]:
    with np.errstate(over="ignore", invalid="ignore"):
        return decoder(encoding)(values.astype(np.float32)).astype(np.float32)


def _warn_of_profile(spec: oiio.ImageSpec, path: str | Path) -> None:
    profile = spec.get_string_attribute("ICCProfile:profile_description")
    if profile and "srgb" not in profile.lower() and "709" not in profile:
        log.warning(
            "%s: its colour profile is %r; its primaries are taken for Rec. 709: convert it to sRGB for exact colours", path, profile
        )
