"""Image files by OpenImageIO, and OpenEXR files of named float32 channels; the same pixels give the same bytes.

OpenImageIO writes the date into every EXR: here the date is fixed. It leaves an EXR incomplete until its output object
is deleted, and neither `close` nor the deletion reports a full disk. So it encodes into memory, and the bytes go to
disk by a writer that does report it.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
from jaxtyping import Float

from factorlib.errors import InputError
from factorlib.reading import check_plain
from factorlib.wholefile import bytes_of, write_bytes

FIXED_DATE = "2000:01:01 00:00:00"
LAT_LONG = {"textureformat": "LatLong Environment"}  # OpenImageIO's name of the OpenEXR attribute `envmap`
FORMATS = {"uint8": oiio.UINT8, "uint16": oiio.UINT16, "float32": oiio.FLOAT}
Channels = Mapping[str, Float[np.ndarray, "h w"]]


def encode_pixels(
    name: str | Path,
    pixels: np.ndarray,
    attributes: Mapping[str, Any] | None = None,
    channels: Sequence[str] | None = None,
) -> bytes:
    """Encode `pixels` [h, w, c] as an image file in the format of the suffix of `name`.

    Args:
        name: Name of the file.
        pixels: Pixels: 8- or 16-bit integers, or float32.
        attributes: Attributes of the file.
        channels: Names of the channels; None for those of the format.

    Returns:
        The bytes of the file.

    Raises:
        OSError: If encoding fails.
    """
    height, width, count = pixels.shape
    spec = oiio.ImageSpec(width, height, count, FORMATS[pixels.dtype.name])
    if channels is not None:
        spec.channelnames = list(channels)
    for key, value in (attributes or {}).items():
        spec.attribute(key, value)

    def encode(memory: str) -> None:
        """Write the image to the path `memory`, a file in memory."""
        output = oiio.ImageOutput.create(str(name))
        if output is None:
            raise OSError(f"{name}: cannot be written: {oiio.geterror()}")
        written = output.open(memory, spec) and output.write_image(np.ascontiguousarray(pixels))
        error = output.geterror()
        closed = output.close()
        error = error or output.geterror()
        del output
        if not (written and closed):
            raise OSError(f"{name}: cannot be written: {error}")

    return bytes_of(encode)


def write_exr(path: str | Path, channels: Channels, attributes: Mapping[str, str | int | float] | None = None) -> None:
    """Write `channels` (name -> [h, w], any real type) as float32, ZIP-compressed, in the given order.

    Args:
        path: File to write.
        channels: Channels by name.
        attributes: Further attributes.
    """
    pixels = np.stack([np.asarray(values, dtype=np.float32) for values in channels.values()], axis=-1)
    fixed = {"compression": "zip", "DateTime": FIXED_DATE, "Software": "factorlib"}
    write_bytes(path, encode_pixels(path, pixels, {**fixed, **(attributes or {})}, list(channels)))


def write_rgb_exr(path: str | Path, radiance: Float[np.ndarray, "h w 3"], attributes: Mapping | None = None) -> None:
    """Write linear Rec. 709 radiance.

    Args:
        path: File to write.
        radiance: Radiance.
        attributes: Further attributes.
    """
    write_exr(path, dict(zip("RGB", np.moveaxis(np.asarray(radiance), -1, 0))), attributes)


def write_hdr(path: str | Path, radiance: Float[np.ndarray, "h w 3"]) -> None:
    """Write linear radiance, Rec. 709, as RGBE: the error of a channel is up to 1/256 of the pixel's brightest channel.

    Other programs read a file without alpha and without a layout attribute as a lat-long map.
    """
    write_bytes(path, encode_pixels(path, np.asarray(radiance, dtype=np.float32)))


def read_exr(path: str | Path) -> dict[str, Float[np.ndarray, "h w"]]:
    """Read all channels of an EXR as float32, by name.

    Raises:
        InputError: If the file is not an EXR, or not a plain file (a pipe would never end).
    """
    check_plain(path, "an image", most_bytes=None)
    source = oiio.ImageInput.open(str(path))
    if source is None:
        raise InputError(
            f"not readable as an image ({oiio.geterror()})",
            file=path,
            cure="the file is damaged or not an EXR: copy or export it again",
        )
    names = list(source.spec().channelnames)
    pixels = source.read_image(oiio.FLOAT)
    error = source.geterror()
    source.close()
    if pixels is None:
        raise InputError(f"truncated or damaged ({error})", file=path, cure="copy it again from its source")
    return {name: np.ascontiguousarray(pixels[..., k]) for k, name in enumerate(names)}


def read_rgb_exr(path: str | Path) -> Float[np.ndarray, "h w 3"]:
    """Read the channels R, G, B of an EXR; InputError if one is missing."""
    channels = read_exr(path)
    for name in "RGB":
        if name not in channels:
            raise InputError(
                f"has no channel {name}, only {', '.join(channels)}",
                file=path,
                cure="save it as an RGB image, with channels R, G and B",
            )
    return np.stack([channels[name] for name in "RGB"], axis=-1)
