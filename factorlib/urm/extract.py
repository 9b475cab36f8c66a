"""Geometry of every pixel of a photo (the maps of `align` and `surface`), and observations from it and its radiance.

A pixel is observed where the mask and the mesh have the same material, the radiance is valid, and the shading normal
faces the camera. Elsewhere normal and radiance do not belong together.
"""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import msgspec
import numpy as np
from jaxtyping import Bool, Float

from factorlib.errors import InputError
from factorlib.images.exr import read_exr
from factorlib.light.distance import back_project, relative_positions
from factorlib.urm.observations import Observations

Channels = Mapping[str, Float[np.ndarray, "h w"]]
LEAST_WEIGHT = 1e-6  # weight of a point whose normal has no confidence, in the centre of all points
GRAZING = 0.05  # least n·o: beyond 87° neither the normal nor the pixel's footprint is reliable


class PhotoSource(msgspec.Struct, frozen=True):
    """Name of a photo, its illumination, and its exposure from EXIF.

    The exposure is t·S/N² (time, ISO speed, f-number), None if it is unknown.
    """

    photo: str
    illumination: str
    exposure: float | None = None


def observed_pixels(photo: Channels, geometry: Channels, least_confidence: float = 0.0) -> Bool[np.ndarray, "h w"]:
    """Select the pixels on which mask and mesh agree on the material and the surface faces the camera.

    Args:
        photo: Channels of the stage `masks`.
        geometry: Channels of the stage `align`.
        least_confidence: Pixels whose confidence is not greater are excluded.

    Returns:
        A mask.
    """
    facing = sum(geometry[f"normal.{a}"] * geometry[f"view.{a}"] for a in "xyz") > GRAZING
    agrees = np.rint(photo["label"]) == np.rint(geometry["label"])
    labelled = photo["label"] > 0.5
    return labelled & agrees & facing & (photo["valid"] > 0.5) & (geometry["confidence"] > least_confidence)


def surface_centre(geometry: Channels) -> Float[np.ndarray, "3"]:
    """Return the mean of the visible surface points, weighted by confidence, in the camera's frame; 0 without any."""
    view, depth = np.stack([geometry[f"view.{a}"] for a in "xyz"], axis=-1), geometry["depth"]
    visible = (depth > 0) & (view[..., 2] < 0)
    if not visible.any():
        return np.zeros(3)
    points = back_project(view[visible], depth[visible])
    return np.average(points, axis=0, weights=geometry["confidence"][visible] + LEAST_WEIGHT)


def extract_observations(
    photo: Channels, geometry: Channels, source: PhotoSource, materials: Sequence[str], least_confidence: float = 0.0
) -> Observations:
    """Extract one observation per observed pixel, in row order.

    Args:
        photo: Channels R, G, B, label, valid, clipped.R/G/B of the stage `masks`.
        geometry: Channels normal.x/y/z, view.x/y/z, depth, label, object, confidence of the stage `align`.
        source: Name, illumination and exposure of the photo.
        materials: Names of all materials, in the order of their labels.
        least_confidence: Pixels whose normals are less certain are excluded; from 0 to 1.

    Returns:
        The observations; `weight` and `confidence` are the confidence of the pixel's normal, from 0 to 1.
    """
    pixels = observed_pixels(photo, geometry, least_confidence)
    y, x = np.nonzero(pixels)
    zero = np.zeros(len(x), "i4")
    sure = geometry["confidence"][pixels]

    def gather(channels: Channels, names: Iterable[str]) -> np.ndarray:
        """Stack the named channels at the observed pixels."""
        return np.stack([channels[n][pixels] for n in names], axis=-1)

    normal, view = (gather(geometry, [f"{name}.{axis}" for axis in "xyz"]) for name in ("normal", "view"))
    normal, view = (v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-12) for v in (normal, view))
    place = relative_positions(view, geometry["depth"][pixels].astype(float), sure)
    return Observations(
        normal,
        view,
        np.maximum(gather(photo, "RGB"), 0.0),
        gather(photo, [f"clipped.{c}" for c in "RGB"]) > 0.5,
        material=np.rint(photo["label"][pixels]).astype("i2") - 1,
        photo=zero,
        illumination=zero,
        x=x.astype("i4"),
        y=y.astype("i4"),
        weight=sure,
        confidence=sure,
        place=place.astype("f4"),
        object=np.rint(geometry["object"][pixels]).astype("i2"),
        materials=tuple(materials),
        photos=(source.photo,),
        illuminations=(source.illumination,),
        exposures=(source.exposure,),
    )


def read_geometry(
    align: Path, surface: Path | None, photo: str, texture: Path | None = None
) -> dict[str, Float[np.ndarray, "h w"]]:
    """Read the maps that `align` wrote of a photo.

    Normals of `surface` replace them, and its detail.R, G, B are added; those of `texture` replace these.

    Args:
        align: Folder of the stage `align`.
        surface: Folder of the stage `surface`, if any.
        photo: Name of the photo.
        texture: Folder of the stage `texture`, if any.

    Returns:
        Channels by name.
    """
    return {**read_exr(align / f"{photo}.exr"), **_photo_maps(surface, photo), **_photo_maps(texture, photo)}


def with_surface_normals(observations: Observations, surface: Path | None) -> Observations:
    """Replace normals and detail of one photo's observations by those in the folder of `surface`, if it has any.

    A merged observation gets the normal of the first pixel of its group.

    Raises:
        InputError: If the maps have another size than the photo.
    """
    if not observations.photos or not (maps := _photo_maps(surface, observations.photos[0])):
        return observations
    height, width = maps["normal.x"].shape
    if len(observations) and (observations.x.max() >= width or observations.y.max() >= height):
        reached = f"pixel ({observations.x.max()}, {observations.y.max()})"
        raise InputError(
            f"its normal maps are {width} × {height} pixels, but the photo's observations reach {reached}",
            file=surface,
            key=observations.photos[0],
            cure="run the stage `surface` again",
        )
    normal = np.stack([maps[f"normal.{axis}"][observations.y, observations.x] for axis in "xyz"], axis=-1)
    known = (normal != 0).any(1, keepdims=True)
    detail = np.stack([maps[f"detail.{channel}"][observations.y, observations.x] for channel in "RGB"], axis=-1)
    detail = np.where(known, detail, 1.0).astype(np.float32)
    normal = np.where(known, normal, observations.normal).astype(np.float32)
    return msgspec.structs.replace(observations, normal=normal, detail=detail, given_normal=observations.cell_normal)


def _photo_maps(surface: Path | None, photo: str) -> dict[str, Float[np.ndarray, "h w"]]:
    """Read the maps of a photo in the folder of `surface`; empty if there are none."""
    if surface is None:
        return {}
    file = surface / "photos" / f"{photo}.exr"
    return read_exr(file) if file.exists() else {}
