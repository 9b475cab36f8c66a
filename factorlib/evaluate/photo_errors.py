"""Errors of the re-synthesis of photos from the solved materials and light, which need no truth.

A pixel counts if mask and mesh name the same material, the surface faces the camera, and no channel of the photo is
clipped.  It counts whether or not the solve used it.  Other pixels are reported as `clipped`, `invalid` (left out by
the mask or not finite) and `uncovered` (in the mask, but not explained by the mesh).  `unused` pixels count, but the
solve did not use them because their normals had no confidence.  `clipped_satisfied` is the fraction of the clipped
pixels whose re-synthesis reaches the clipped value, up to 2 %.

The null gives each material in each photo one flat colour, its own mean over the counted pixels.
"""

from collections.abc import Callable, Iterable, Mapping

import msgspec
import numpy as np
from jaxtyping import Bool, Float

from factorlib.evaluate.comparison_gauge import GAUGES, gauge_factors
from factorlib.evaluate.picture_errors import mean_scored, picture_errors, white_of
from factorlib.results.materials import vec3
from factorlib.results.metrics import PhotoErrors, PictureError, ResynthesisErrors, ScoredPicture
from factorlib.urm.extract import observed_pixels

Picture = Float[np.ndarray, "h w 3"]
Channels = Mapping[str, Float[np.ndarray, "h w"]]


class ComparedPhoto(msgspec.Struct, frozen=True):
    """One photo with its re-synthesis.

    Attributes:
        label: material, 1 to m
        pixels: mask of the pixels that count
        white: radiance that the tone map shows as white
        counts: numbers of pixels by kind
        clipped_satisfied: see the module
    """

    photo: Picture
    resynthesis: Picture
    label: Float[np.ndarray, "h w"]
    pixels: Bool[np.ndarray, "h w"]
    white: float
    counts: dict[str, int]
    clipped_satisfied: float | None


def compared_photo(photo: Channels, geometry: Channels, resynthesis: Picture) -> ComparedPhoto:
    """Combine a photo with its re-synthesis.

    Args:
        photo: channels of the stage `masks`
        geometry: channels of the stage `align`
        resynthesis: linear radiance, of the photo's size
    """
    label = np.rint(photo["label"])
    clipped = np.any([photo[f"clipped.{c}"] > 0.5 for c in "RGB"], axis=0)
    rgb = np.nan_to_num(np.stack([photo[c] for c in "RGB"], axis=-1), posinf=0.0, neginf=0.0)
    valid = photo["valid"] > 0.5
    observed = agreeing_pixels(photo, geometry)
    pixels = observed & ~clipped
    bounds = observed & clipped
    left_out = photo["left_out"] > 0.5 if "left_out" in photo else np.zeros(valid.shape, bool)
    counts = {
        "pixels": pixels,
        "unused": pixels & ~observed_pixels(photo, geometry),
        "clipped": bounds,
        "uncovered": valid & ~observed,
        "invalid": left_out | ((label > 0.5) & ~valid),
    }
    satisfied = (resynthesis >= 0.98 * rgb)[bounds].all(axis=-1)
    return ComparedPhoto(
        rgb,
        resynthesis,
        label,
        pixels,
        white_of(rgb, pixels),
        {k: int(v.sum()) for k, v in counts.items()},
        float(satisfied.mean()) if bounds.any() else None,
    )


def agreeing_pixels(photo: Channels, geometry: Channels) -> Bool[np.ndarray, "h w"]:
    """Return a mask of the pixels where mask and mesh name the same material and the surface faces the camera.

    The confidence of the normals is ignored.
    """
    return observed_pixels(photo, {**geometry, "confidence": np.ones_like(geometry["confidence"])})


def compare_photos(
    names: Iterable[str], materials: list[str], read: Callable[[str], ComparedPhoto]
) -> ResynthesisErrors:
    """Return the errors of all photos.

    Only one photo is in memory at a time, apart from the samples of the counted pixels.

    Args:
        names: names of the photos
        materials: names by label, from 1
        read: reads a photo by name
    """
    factors = _factors(list(names), read)
    photos = {name: _photo_errors(read(name), materials, factor) for name, factor in factors.items()}
    scored = [p.gauges for p in photos.values() if p.gauges]
    if not scored:
        return ResynthesisErrors(photos, None, None, None)
    mean = {g: mean_scored([s[g] for s in scored]) for g in GAUGES}
    worst = [min(getattr(s["none"].estimate, f"psnr_{kind}_db") for s in scored) for kind in ("linear", "tonemapped")]
    return ResynthesisErrors(photos, mean, *worst)


def flat_materials(photo: ComparedPhoto) -> Picture:
    """Return the null: every material of the photo in its mean colour."""
    flat = np.zeros_like(photo.photo)
    for label in np.unique(photo.label[photo.pixels]):
        pixels = photo.pixels & (photo.label == label)
        flat[pixels] = photo.photo[pixels].mean(axis=0)
    return flat


def _factors(names: list[str], read: Callable[[str], ComparedPhoto]) -> dict[str, dict[str, Float[np.ndarray, "3"]]]:
    estimates = []
    truths = []
    whites = []
    for name in names:
        photo = read(name)
        estimates.append(photo.resynthesis[photo.pixels])
        truths.append(photo.photo[photo.pixels])
        whites.append(photo.white)
    factors = gauge_factors(estimates, truths, whites, below_white=True)
    return {name: {g: factors[g][i] for g in GAUGES} for i, name in enumerate(names)}


def _photo_errors(photo: ComparedPhoto, materials: list[str], factor: dict[str, Float[np.ndarray, "3"]]) -> PhotoErrors:
    regions = {m: photo.pixels & (photo.label == k) for k, m in enumerate(materials, start=1)}
    null = _scored(flat_materials(photo), photo, regions)
    errors = {g: _scored(photo.resynthesis * factor[g], photo, regions) for g in GAUGES}

    def scores(region: str) -> dict[str, ScoredPicture]:
        """Return the scores of a region in each gauge."""
        return {g: ScoredPicture(errors[g][region], null[region]) for g in GAUGES}

    return PhotoErrors(
        exposure=1 / photo.white,
        **photo.counts,
        clipped_satisfied=photo.clipped_satisfied,
        factor={g: vec3(f) for g, f in factor.items()},
        gauges=scores("") if photo.pixels.any() else None,
        materials={m: scores(m) for m in materials if regions[m].any()},
    )


def _scored(estimate: Picture, photo: ComparedPhoto, regions: dict) -> dict[str, PictureError]:
    estimate = np.nan_to_num(estimate, posinf=0.0, neginf=0.0)
    return picture_errors(estimate, photo.photo, {"": photo.pixels, **regions}, photo.white)
