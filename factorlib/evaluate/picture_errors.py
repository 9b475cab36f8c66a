"""Errors of pictures of linear radiance inside a mask, and of the re-synthesis of photos, which needs no truth.

PSNR      10 log10(peak² / mean squared error), dB: in linear radiance, where `peak` is the truth's white, and
          after the tone map, where the peak is 1.  A perfect match has 120 dB, so that every number is finite.
DSSIM     (1 − SSIM) / 2; SSIM after Wang, Bovik, Sheikh and Simoncelli 2004: Gaussian window of 11 × 11 pixels with
          σ = 1.5, C1 = 0.01², C2 = 0.03².  The window is renormalised to the mask, so that nothing outside leaks in.
Tone map  clip(exposure · radiance, 0, 1)^(1/2.2) with exposure = 1 / white, the same for both pictures.
White     The 99th percentile, over the mask, of the truth's brightest channel.

A pixel of a re-synthesis counts if mask and mesh name the same material, the surface faces the camera, and no channel
of the photo is clipped.  It counts whether or not the solve used it.  Other pixels are reported as `clipped`, `invalid`
(left out by the mask or not finite) and `uncovered` (in the mask, but not explained by the mesh).  `unused` pixels
count, but the solve did not use them because their normals had no confidence.  `clipped_satisfied` is the fraction of
the clipped pixels whose re-synthesis reaches the clipped value, up to 2 %.  The null gives each material in each photo
one flat colour, its own mean over the counted pixels.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TypeVar

import msgspec
import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import correlate1d, find_objects

from factorlib.evaluate.comparison_gauge import GAUGES, gauge_factors
from factorlib.results.materials import vec3
from factorlib.results.metrics import (
    ErrorWithNull,
    LightError,
    PhotoErrors,
    PictureError,
    ResynthesisErrors,
    ScoredPicture,
)
from factorlib.urm.extract import observed_pixels

Picture = Float[np.ndarray, "h w 3"]
Mask = Bool[np.ndarray, "h w"]
Error = TypeVar("Error", PictureError, LightError)

HIGHEST_PSNR = 120.0
WHITE_PERCENTILE = 99.0
WINDOW = np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2)
WINDOW = WINDOW / WINDOW.sum()


def white_level(truth: Picture, mask: Mask) -> float:
    """Return the radiance that the tone map shows as white; 1 for a picture that is black or empty."""
    if not mask.any():
        return 1.0
    white = float(np.percentile(truth[mask].max(axis=-1), WHITE_PERCENTILE))
    return white if white > 0 else 1.0


def tone_map(radiance: Float[np.ndarray, "*s 3"], exposure: float) -> Float[np.ndarray, "*s 3"]:
    """Return display values in [0, 1].

    >>> float(tone_map(np.array([0.25, 1.0, 9.0]), 2.0)[0].round(3))
    0.73
    """
    return np.clip(radiance * exposure, 0.0, 1.0) ** (1 / 2.2)


def psnr(estimate: Float[np.ndarray, "n 3"], truth: Float[np.ndarray, "n 3"], peak: float) -> float:
    """Return the PSNR in dB over all entries, at most 120.

    Args:
        estimate: estimated values
        truth: true values
        peak: the value of white

    >>> psnr(np.full((5, 3), 0.9), np.ones((5, 3)), 1.0)
    20.0
    """
    error = float(np.mean((np.asarray(estimate, float) - truth) ** 2)) / peak**2
    return round(min(HIGHEST_PSNR, -10 * math.log10(max(error, 1e-300))), 6)


def ssim_map(a: Picture, b: Picture, mask: Mask) -> Float[np.ndarray, "h w"]:
    """Return the SSIM of each pixel of the mask, averaged over channels; 0 outside.

    Args:
        a: display values in [0, 1]
        b: display values in [0, 1]
        mask: pixels to compare
    """
    inside = mask[..., None].astype(np.float32)
    total = np.maximum(_blur(inside), 1e-12)

    def mean(values: np.ndarray) -> np.ndarray:
        """Return Gaussian-weighted local means over the mask."""
        return _blur(values * inside) / total

    # SSIM = (2 μa μb + C1)(2 cov + C2) / ((μa² + μb² + C1)(var a + var b + C2)), from local moments
    a = a.astype(np.float32)
    b = b.astype(np.float32)
    mean_a = mean(a)
    mean_b = mean(b)
    var_a = mean(a * a) - mean_a**2
    var_b = mean(b * b) - mean_b**2
    covariance = mean(a * b) - mean_a * mean_b
    c1 = 0.01**2
    c2 = 0.03**2
    similar = (2 * mean_a * mean_b + c1) * (2 * covariance + c2)
    return (similar / ((mean_a**2 + mean_b**2 + c1) * (var_a + var_b + c2))).mean(axis=-1) * mask


def picture_errors(
    estimate: Picture, truth: Picture, regions: dict[str, Mask], white: float
) -> dict[str, PictureError]:
    """Return the errors of a picture in each region; empty regions are left out.

    Args:
        estimate: linear radiance
        truth: linear radiance
        regions: masks by name; the SSIM window covers their union
        white: radiance that the tone map shows as white
    """
    regions = {name: region for name, region in regions.items() if region.any()}
    if not regions:
        return {}
    union = np.logical_or.reduce(list(regions.values()))
    (box,) = find_objects(union.astype(np.uint8))
    estimate = estimate[box]
    truth = truth[box]
    union = union[box]
    displayed = [tone_map(np.where(union[..., None], p, 0.0), 1 / white) for p in (estimate, truth)]
    ssim = ssim_map(displayed[0], displayed[1], union)

    def error(region: Mask) -> PictureError:
        """Return the errors inside one region."""
        psnr_linear = psnr(estimate[region], truth[region], white)
        dssim = round(float(np.clip((1 - ssim[region].mean()) / 2, 0, 1)), 9)
        return PictureError(psnr_linear, psnr(displayed[0][region], displayed[1][region], 1.0), dssim)

    return {name: error(region[box]) for name, region in regions.items()}


def picture_error(estimate: Picture, truth: Picture, mask: Mask, white: float) -> PictureError:
    """Return the errors of a picture inside one mask.

    Args:
        estimate: linear radiance
        truth: linear radiance
        mask: pixels to compare, at least one
        white: radiance that the tone map shows as white
    """
    return picture_errors(estimate, truth, {"": mask}, white)[""]


def mean_error(errors: Sequence[Error], digits: int = 6) -> Error:
    """Return the mean of each number over errors of one kind (of dB, for PSNR), rounded; there must be at least one."""
    values = np.array([msgspec.structs.astuple(e) for e in errors])
    return type(errors[0])(*(round(float(np.mean(column)), digits) for column in values.T))


def mean_error_with_null(scored: Sequence[ErrorWithNull[Error]], digits: int = 6) -> ErrorWithNull[Error]:
    """Return the mean of estimates and the mean of nulls, each by `mean_error`."""
    return ErrorWithNull(
        *(mean_error([getattr(each, part) for each in scored], digits) for part in ("estimate", "null"))
    )


def _blur(values: Float[np.ndarray, "h w c"]) -> Float[np.ndarray, "h w c"]:
    for axis in (0, 1):
        values = correlate1d(values, WINDOW, axis=axis, mode="constant")
    return values


Channels = Mapping[str, Float[np.ndarray, "h w"]]


class ComparedPhoto(msgspec.Struct, frozen=True):
    """One photo with its re-synthesis.

    Attributes:
        label: material, 1 to m
        pixels: mask of the pixels that count
        white: radiance that the tone map shows as white
        counts: numbers of pixels by kind
        clipped_satisfied: fraction of the clipped pixels whose re-synthesis reaches the clipped value; None without any
    """

    photo: Picture
    resynthesis: Picture
    label: Float[np.ndarray, "h w"]
    pixels: Bool[np.ndarray, "h w"]
    white: float
    counts: dict[str, int]
    clipped_satisfied: float | None


def combine_photo(photo: Channels, geometry: Channels, resynthesis: Picture) -> ComparedPhoto:
    """Return a photo with its re-synthesis, the mask of the pixels that count, and the numbers of the others.

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
        white_level(rgb, pixels),
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
    """Compare each re-synthesis with its photo: errors by photo, their means, and the worst PSNR.

    Only one photo is in memory at a time, apart from the samples of the counted pixels.

    Args:
        names: names of the photos
        materials: names by label, from 1
        read: reads a photo by name
    """
    names = list(names)
    samples = [(photo.resynthesis[photo.pixels], photo.photo[photo.pixels], photo.white) for photo in map(read, names)]
    estimates, truths, whites = zip(*samples, strict=True)
    factors = gauge_factors(estimates, truths, whites, below_white=True)
    by_photo = [{gauge: factors[gauge][k] for gauge in GAUGES} for k in range(len(names))]
    photos = {name: _photo_errors(read(name), materials, factor) for name, factor in zip(names, by_photo, strict=True)}
    scored = [p.gauges for p in photos.values() if p.gauges]
    if not scored:
        return ResynthesisErrors(photos, None, None, None)
    mean = {g: mean_error_with_null([s[g] for s in scored]) for g in GAUGES}
    worst = [min(getattr(s["none"].estimate, f"psnr_{kind}_db") for s in scored) for kind in ("linear", "tonemapped")]
    return ResynthesisErrors(photos, mean, *worst)


def flat_colours(photo: ComparedPhoto) -> Picture:
    """Return a picture of each material in its own mean colour over the pixels that count, black elsewhere."""
    flat = np.zeros_like(photo.photo)
    for label in np.unique(photo.label[photo.pixels]):
        region = photo.pixels & (photo.label == label)
        flat[region] = photo.photo[region].mean(axis=0)
    return flat


def _photo_errors(photo: ComparedPhoto, materials: list[str], factor: dict[str, Float[np.ndarray, "3"]]) -> PhotoErrors:
    regions = {m: photo.pixels & (photo.label == k) for k, m in enumerate(materials, start=1)}
    null = _score_with_null(flat_colours(photo), photo, regions)
    errors = {g: _score_with_null(photo.resynthesis * factor[g], photo, regions) for g in GAUGES}

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


def _score_with_null(estimate: Picture, photo: ComparedPhoto, regions: dict) -> dict[str, PictureError]:
    estimate = np.nan_to_num(estimate, posinf=0.0, neginf=0.0)
    return picture_errors(estimate, photo.photo, {"": photo.pixels, **regions}, photo.white)
