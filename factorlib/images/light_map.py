"""Reader of lat-long light maps, Radiance HDR or OpenEXR; a large map is downsampled while it is read."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from factorlib.errors import InputError
from factorlib.images.photo import decode_photo, least_factor, open_photo
from factorlib.images.scanlines import check_values
from factorlib.reading import check_plain

MOST_TEXELS = 4096 * 2048  # they take 250 MB when read, and more in a renderer
LEAST = -1e-3  # least radiance, in units of the mean magnitude: resampling leaves small negative values
LARGEST = 1e15  # greatest radiance: the sun's disc is 1e9 times as bright as a room
SUFFIXES = (".hdr", ".exr")


def maps_in(folders: Sequence[Path]) -> list[Path]:
    """List the maps in each folder, by name.

    Raises:
        InputError: If a folder does not exist or has no map.
    """
    paths = []
    for folder in folders:
        if not folder.is_dir():
            raise InputError("there is no such folder", file=folder, cure="name folders of lat-long maps (.hdr, .exr)")
        maps = sorted(path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES)
        if not maps:
            raise InputError(
                "no .hdr or .exr in this folder",
                file=folder,
                cure="name a folder that directly holds lat-long maps; its subfolders are not searched",
            )
        paths += maps
    return paths


def read_light_map(path: Path, key: str | None = None) -> Float[np.ndarray, "h w 3"]:
    """Read the linear radiance of a lat-long map; more than MOST_TEXELS are downsampled by a whole factor.

    Args:
        path: File of the map.
        key: Key to name in errors.

    Returns:
        Radiance.

    Raises:
        InputError: If the file is not a map, is black, or has radiance that is NaN, infinite, or negative beyond
            what resampling leaves.
    """
    check_plain(path, "a light", key, most_bytes=None)
    check_values(path, key=key)
    opened = open_photo(path, key)
    height, width = opened.size
    if width != 2 * height:
        raise InputError(
            f"has {width} × {height} pixels; a lat-long map is twice as wide as high",
            file=path,
            key=key,
            cure="name a lat-long map, or convert this one",
        )
    least = np.inf
    total = 0.0
    lost = 0

    def look(linear: Float[np.ndarray, "r w 3"]) -> None:
        """Accumulate statistics of some rows of the map as opened."""
        nonlocal least, total, lost
        usable = np.isfinite(linear) & (np.abs(linear) <= LARGEST)
        lost += int((~usable.all(axis=-1)).sum())
        numbers = np.where(usable, linear, 0)
        least = min(least, float(numbers.min()))
        total = total + float(np.abs(numbers).sum(dtype=float))

    factor = least_factor(height * width, MOST_TEXELS)
    factor = next((divisor for divisor in range(factor, 2 * factor) if height % divisor == 0), factor)
    radiance = decode_photo(opened, "linear", factor, path, look).radiance
    if lost:
        raise InputError(
            f"{lost} pixels are NaN, infinite or above {LARGEST:g}",
            file=path,
            key=key,
            cure="replace these pixels, or export the map again",
        )
    if least < LEAST * total / (3 * height * width):
        raise InputError(
            f"has a radiance of {least:.4g}, less than 0",
            file=path,
            key=key,
            cure="set negative values to 0 (some resampling filters make them), or export the map again, linear",
        )
    if not (radiance > 0).any():
        raise InputError("the map is black", file=path, key=key, cure="name another map, or export this one again")
    return radiance.astype(float)
