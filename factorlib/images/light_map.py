"""Lat-long maps of light, in Radiance HDR or OpenEXR: read by header first, a large one averaged down while it is read."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from factorlib.errors import InputError
from factorlib.images.boxes import least_factor
from factorlib.images.limits import check_values
from factorlib.images.photo import decoded, open_photo
from factorlib.reading import check_plain

MOST_TEXELS = 4096 * 2048  # which take 250 MB as they are read, and more in a renderer
LEAST = -1e-3  # of the mean magnitude: resampling leaves a little below 0
LARGEST = 1e15  # radiance: the sun's disc is 1e9 times as bright as a room
SUFFIXES = (".hdr", ".exr")
CURE = "mend or remove this map"


def maps_in(folders: Sequence[Path]) -> list[Path]:
    """The maps in each folder, by name; InputError for what is no folder, and for a folder without any."""
    found = []
    for folder in folders:
        if not folder.is_dir():
            raise InputError("no such folder", file=folder, cure="name folders of lat-long maps (.hdr, .exr)")
        here = sorted(path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES)
        if not here:
            cure = "name a folder of lat-long maps; folders within it count by themselves"
            raise InputError("no .hdr or .exr in this folder", file=folder, cure=cure)
        found += here
    return found


def read_light_map(path: Path, key: str | None = None) -> Float[np.ndarray, "h w 3"]:
    """Linear radiance of a lat-long map; one of more than MOST_TEXELS is averaged down by a whole factor.

    key: where the map is named, for messages.  Raises InputError for a file that is no map, is black, or holds radiance that is
    no number, infinite, or less than 0 (by more than resampling leaves).
    """
    check_plain(path, "a light", key, most_bytes=None)
    check_values(path, key=key)
    stored = open_photo(path, key)
    height, width = stored.size
    if width != 2 * height:
        fault = f"{width} × {height} pixels is no lat-long map"
        raise InputError(fault, file=path, key=key, cure="its width must be twice its height")
    least, total, lost = np.inf, 0.0, 0

    def look(linear: Float[np.ndarray, "r w 3"]) -> None:
        """Take in some rows of the map as they are stored."""
        nonlocal least, total, lost
        usable = np.isfinite(linear) & (np.abs(linear) <= LARGEST)
        lost += int((~usable.all(axis=-1)).sum())
        numbers = np.where(usable, linear, 0)
        least, total = min(least, float(numbers.min())), total + float(np.abs(numbers).sum(dtype=float))

    factor = least_factor(height * width, MOST_TEXELS)
    factor = next((divisor for divisor in range(factor, 2 * factor) if height % divisor == 0), factor)
    radiance = decoded(stored, "linear", factor, path, look).radiance
    if lost:
        fault = f"{lost} pixels are no numbers, or infinite (more than {LARGEST:g})"
        raise InputError(fault, file=path, key=key, cure=CURE)
    if least < LEAST * total / (3 * height * width):
        cure = "give linear radiance: was a filter with negative lobes used? cut it at 0"
        raise InputError(f"a radiance of {least:.4g} is less than 0", file=path, key=key, cure=cure)
    if not (radiance > 0).any():
        raise InputError("the map is black", file=path, key=key, cure=CURE)
    return radiance.astype(float)
