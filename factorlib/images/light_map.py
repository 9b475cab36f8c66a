"""Lat-long maps of light in files of other programs: Radiance HDR and OpenEXR."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float

from factorlib.errors import InputError
from factorlib.images.photo import read_photo


def read_light_map(path: Path) -> Float[np.ndarray, "h w 3"]:
    """Linear radiance of a lat-long map; InputError for a file that is none, is black, or holds what is no number."""
    photo = read_photo(path, "linear")
    if photo.width != 2 * photo.height:
        fault = f"{photo.width} × {photo.height} pixels is no lat-long map"
        raise InputError(fault, file=path, cure="its width must be twice its height")
    if not photo.finite.all():
        raise InputError(f"{(~photo.finite).sum()} pixels are no numbers", file=path, cure="mend or remove this map")
    if not (photo.radiance > 0).any():
        raise InputError("the map is black", file=path, cure="mend or remove this map")
    return photo.radiance.astype(float)
