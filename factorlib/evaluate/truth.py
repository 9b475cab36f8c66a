"""Maps of a truth, read and checked: a true light is radiance, true normals have the photo's size."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from factorlib.errors import InputError
from factorlib.images.exr import read_exr
from factorlib.images.light_map import read_light_map
from factorlib.reading import reading


def read_true_light(path: Path, name: str) -> Float[np.ndarray, "h w 3"]:
    """Read the lat-long map of illumination `name`; InputError if a texel is not a valid radiance."""
    return read_light_map(path, f"illumination.{name}").astype(np.float32)


def read_true_normals(path: Path, name: str, size: tuple[int, int]) -> Float[np.ndarray, "h w 3"]:
    """Read the true normals of a photo from channels normal.x/y/z, or R, G, B.

    Args:
        path: the EXR file
        name: name of the photo
        size: width and height of the photo

    Returns:
        Normals, zero or NaN where unknown.

    Raises:
        InputError: The file lacks a channel, has another size, or holds an infinite value.
    """
    key = f"normals.{name}"
    with reading("an image", path, key):
        channels = read_exr(path)
    names = [f"normal.{axis}" for axis in "xyz"] if "normal.x" in channels else list("RGB")
    missing = [channel for channel in names if channel not in channels]
    if missing:
        found = f"has no channel {missing[0]}, only {', '.join(channels)}"
        raise InputError(found, file=path, key=key, cure="normals are normal.x, normal.y, normal.z, or R, G, B")
    normals = np.stack([channels[channel] for channel in names], axis=-1)
    if normals.shape[1::-1] != tuple(size):
        found = f"the normals have {normals.shape[1]} × {normals.shape[0]} pixels, the photo {size[0]} × {size[1]}"
        raise InputError(found, file=path, key=key, cure="render them with the photo's own pixels")
    if np.isinf(normals).any():
        raise InputError("a normal is infinite", file=path, key=key, cure="write 0 where there is none")
    return normals
