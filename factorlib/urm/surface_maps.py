"""Geometry of every pixel of a photo: the maps of `align`, and those of `surface` if there are any."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
from jaxtyping import Float

from factorlib.errors import InputError
from factorlib.images.exr import read_exr
from factorlib.urm.observations import Observations


def read_geometry(align: Path, surface: Path | None, photo: str) -> dict[str, Float[np.ndarray, "h w"]]:
    """Read the maps that `align` wrote of a photo; those of `surface` replace its normals and add the channel `detail`.

    Args:
        align: Folder of the stage `align`.
        surface: Folder of the stage `surface`, if any.
        photo: Name of the photo.

    Returns:
        Channels by name.
    """
    return {**read_exr(align / f"{photo}.exr"), **_normals(surface, photo)}


def with_surface_normals(observations: Observations, surface: Path | None) -> Observations:
    """Replace normals and detail of one photo's observations by those in the folder of `surface`, if it has any.

    A merged observation gets the normal of the first pixel of its group.

    Raises:
        InputError: If the maps have another size than the photo.
    """
    if not observations.photos or not (maps := _normals(surface, observations.photos[0])):
        return observations
    height, width = maps["normal.x"].shape
    if len(observations) and (observations.x.max() >= width or observations.y.max() >= height):
        raise InputError(
            f"its normals are of a picture of {width} × {height}",
            file=surface,
            key=observations.photos[0],
            cure="run the stage `surface` again",
        )
    normal = np.stack([maps[f"normal.{axis}"][observations.y, observations.x] for axis in "xyz"], axis=-1)
    known = (normal != 0).any(1, keepdims=True)
    detail = np.where(known[:, 0], maps["detail"][observations.y, observations.x], 1.0).astype(np.float32)
    normal = np.where(known, normal, observations.normal).astype(np.float32)
    return msgspec.structs.replace(observations, normal=normal, detail=detail)


def _normals(surface: Path | None, photo: str) -> dict[str, Float[np.ndarray, "h w"]]:
    """Read the maps of a photo in the folder of `surface`; empty if there are none."""
    if surface is None:
        return {}
    file = surface / "photos" / f"{photo}.exr"
    return read_exr(file) if file.exists() else {}
