"""OpenEXR files of named float32 channels, through OpenImageIO; the same channels are the same bytes.

OpenImageIO stamps the date into every file: here the date is fixed.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
from jaxtyping import Float

from factorlib.errors import InputError
from factorlib.images.write import write_image
from factorlib.reading import check_plain

FIXED_DATE = "2000:01:01 00:00:00"
LAT_LONG = {"textureformat": "LatLong Environment"}  # OpenImageIO's word for the OpenEXR attribute `envmap`
Channels = Mapping[str, Float[np.ndarray, "h w"]]


def write_exr(path: str | Path, channels: Channels, attributes: Mapping[str, str | int | float] | None = None) -> None:
    """Write `channels` (name -> [h, w], any real type) as float32, ZIP-compressed, in the order given."""
    names = list(channels)
    pixels = np.stack([np.asarray(channels[n], dtype=np.float32) for n in names], axis=-1)
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], len(names), oiio.FLOAT)
    spec.channelnames = names
    fixed = {"compression": "zip", "DateTime": FIXED_DATE, "Software": "factorlib"}
    for name, value in {**fixed, **(attributes or {})}.items():
        spec.attribute(name, value)
    write_image(path, spec, pixels)


def write_rgb_exr(path: str | Path, radiance: Float[np.ndarray, "h w 3"], attributes: Mapping | None = None) -> None:
    """Write linear Rec. 709 radiance."""
    write_exr(path, dict(zip("RGB", np.moveaxis(np.asarray(radiance), -1, 0))), attributes)


def read_exr(path: str | Path) -> dict[str, Float[np.ndarray, "h w"]]:
    """All channels of an EXR as float32 by name; InputError for what is none, or no plain file (a pipe would never end)."""
    check_plain(path, "an image", most_bytes=None)
    source = oiio.ImageInput.open(str(path))
    if source is None:
        raise InputError(f"not readable as an image ({oiio.geterror()})", file=path, cure="is it whole, and an EXR?")
    names = list(source.spec().channelnames)
    pixels = source.read_image(oiio.FLOAT)
    error = source.geterror()
    source.close()
    if pixels is None:
        raise InputError(f"truncated or damaged ({error})", file=path, cure="restore the file")
    return {name: np.ascontiguousarray(pixels[..., k]) for k, name in enumerate(names)}


def read_rgb_exr(path: str | Path) -> Float[np.ndarray, "h w 3"]:
    """The channels R, G, B."""
    channels = read_exr(path)
    for name in "RGB":
        if name not in channels:
            fault = f"has no channel {name}, only {', '.join(channels)}"
            raise InputError(fault, file=path, cure="an RGB image is expected")
    return np.stack([channels[name] for name in "RGB"], axis=-1)
