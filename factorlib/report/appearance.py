"""Balls and reflectance maps of every material in every light, and the light itself."""

from __future__ import annotations

import msgspec
import numpy as np
from jaxtyping import Bool, Float

from factorlib.conventions import lat_long_solid_angles
from factorlib.images.picture import exposure_of, picture
from factorlib.report.artifacts import Artifacts, Picture
from factorlib.report.png import data_uri, outline, reduced
from factorlib.results.metrics import ScoredLight
from factorlib.urm.observations import Observations

MAP_SIZE = 64
LEAST_OBSERVED = 0.002  # of a disc: fewer normals than this are not ringed
MAGENTA = (214, 40, 120)


class Cell(msgspec.Struct, frozen=True):
    """A material in a photo's light; `uri` is None where nothing was rendered, `measured` where nothing was seen."""

    material: str
    photo: str
    observed: bool
    uri: str | None
    measured: str | None = None


class LightRow(msgspec.Struct, frozen=True):
    """An environment map: `white` is the radiance shown as white, `peak` the brightest texel in units of it.

    overflow: share of the sphere that is brighter than white, outlined; energy: its share of the light.
    known: share of the sphere where the standard error is below the radiance there, or below the mean radiance where that is larger;
    known_uri: that error as grey, white where it is nil, mid-grey where it is as large, black where it is many times that.
    """

    name: str
    photos: list[str]
    uri: str
    dark_uri: str
    white: float
    peak: float
    overflow: float
    energy: float
    true_uri: str | None
    known_uri: str | None
    known: float | None
    spheres: str | None
    errors: dict[str, dict[str, ScoredLight]] | None


def exposures(run: Artifacts) -> dict[str, float]:
    """One exposure per photo for all balls and reflectance maps in its light: the one its own picture is shown with."""
    metrics = run.metrics()
    photos = metrics.resynthesis.photos if metrics else {}
    return {name: photos[name].exposure if name in photos else 1.0 for name in run.set.photos}


def balls(run: Artifacts, observed: dict[str, list[str]], exposure: dict[str, float]) -> list[list[Cell]]:
    """Rows of materials, columns of photos; observed: the materials that each photo shows."""
    return [[_ball(run, m, p, m in observed[p], exposure[p]) for p in run.set.photos] for m in run.set.materials]


def _ball(run: Artifacts, material: str, photo: str, observed: bool, exposure: float) -> Cell:
    radiance = run.rgb("render", f"materials/{photo}/{material}")
    uri = None if radiance is None else data_uri(disc(reduced(radiance, 96), exposure))
    return Cell(material, photo, observed, uri)


def disc(radiance: Float[np.ndarray, "n n 3"], exposure: float) -> np.ndarray:
    """Display values, transparent outside the disc that fills the picture."""
    height, width = radiance.shape[:2]
    y, x = ((np.arange(n) + 0.5) / n * 2 - 1 for n in (height, width))
    alpha = np.clip((1 - np.hypot(x[None], y[:, None])) * height / 2 + 0.5, 0, 1)
    return np.concatenate([picture(radiance, exposure), np.rint(255 * alpha)[..., None].astype(np.uint8)], axis=-1)


def reflectance_maps(run: Artifacts, photo: str, exposure: float) -> list[Cell]:
    """One cell per material: solved, with the observed normals ringed, and beside it what the photo measured."""
    observations = run.observations(photo)
    return [_map(run, photo, index, name, observations, exposure) for index, name in enumerate(run.set.materials)]


def _map(run: Artifacts, photo: str, index: int, name: str, seen: Observations | None, exposure: float) -> Cell:
    channels = run.exr("render", f"reflectance_maps/{photo}/{name}")
    rows = seen.material == index if seen is not None else np.zeros(0, bool)
    measured = data_uri(measured_map(seen.take(rows), exposure)) if rows.any() else None
    if channels is None:
        return Cell(name, photo, bool(rows.any()), None, measured)
    pixels = disc(np.stack([channels[c] for c in "RGB"], axis=-1), exposure)
    observed = channels.get("observed", np.zeros(pixels.shape[:2])) > 0.5
    if observed.mean() > LEAST_OBSERVED:
        line = outline(observed | ~(pixels[..., 3] > 0))  # white on dark and black on bright
        pixels[line, :3] = np.where(pixels[line, :3].mean(axis=-1, keepdims=True) > 127.5, 0, 255)
    return Cell(name, photo, bool(rows.any()), data_uri(pixels), measured)


def measured_map(observations: Observations, exposure: float) -> np.ndarray:
    """Mean radiance by normal, seen from the front, as RGBA; transparent where no normal was seen.

    The disc is as many cells across as leave about two observations to a cell, at most `MAP_SIZE`.
    """
    n, side = observations.normal, int(np.clip(np.sqrt(len(observations) * 2 / np.pi), 8, MAP_SIZE))
    column, row = (np.clip(((n[:, k] + 1) / 2 * side).astype(int), 0, side - 1) for k in (0, 1))  # x right, y down
    cell = row * side + column
    weight = np.bincount(cell, minlength=side**2)
    total = np.stack([np.bincount(cell, c, side**2) for c in observations.radiance.T], axis=-1)
    mean = (total / np.maximum(weight, 1)[:, None]).reshape(side, side, 3)
    alpha = np.where(weight > 0, 255, 0).astype(np.uint8).reshape(side, side, 1)
    return np.concatenate([picture(mean, exposure), alpha], axis=-1)


def light_row(
    run: Artifacts, name: str, photos: list[str], errors: dict[str, dict[str, ScoredLight]] | None
) -> LightRow | None:
    """The row of light `name`; None where no such light was exported.  errors: its part of metrics.json"""
    radiance = run.rgb("export", f"illumination/{name}")
    if radiance is None:
        return None
    exposure = exposure_of(radiance, percentile=95.0)
    brightest, area = radiance.max(axis=-1) * exposure, _areas(radiance)
    over, energy = brightest > 1, radiance.sum(axis=-1) * area
    true, known = run.rgb("evaluate", f"illumination/{name}"), run.rgb("export", f"coverage/{name}")
    mean = float((radiance * area[..., None]).sum() / (3 * area.sum() * radiance.shape[1]))
    error = None if known is None else known.mean(axis=-1) / np.maximum(1, radiance.mean(axis=-1) / max(mean, 1e-30))
    return LightRow(
        name=name, photos=photos, white=1 / exposure, peak=float(brightest.max()),
        uri=data_uri(_outlined(picture(radiance, exposure), over)), dark_uri=data_uri(picture(radiance, exposure / 16)),
        overflow=float((over * area).sum() / (4 * np.pi)), energy=float((energy * over).sum() / max(energy.sum(), 1e-30)),
        true_uri=None if true is None else data_uri(_true_map(true, radiance, exposure)),
        known_uri=None if error is None else data_uri(np.rint(255 / (1 + np.repeat(error[..., None], 3, -1))).astype(np.uint8)),
        known=None if error is None else float(((error < 1) * area).sum() / (4 * np.pi)),
        spheres=_spheres(run, name), errors=errors,
    )  # fmt: skip


def _areas(lat_long: Picture) -> Float[np.ndarray, "h 1"]:
    return lat_long_solid_angles(*lat_long.shape[:2])[:, None]


def _outlined(pixels: np.ndarray, over: Bool[np.ndarray, "h w"]) -> np.ndarray:
    pixels[outline(over)] = MAGENTA
    return pixels


def _true_map(true: Picture, estimate: Picture, exposure: float) -> np.ndarray:
    """The true map, scaled to the mean of the estimate: the overall scale is a matter of gauge."""
    means = [float((m * (_areas(m)[..., None] / m.shape[1])).sum()) for m in (true, estimate)]
    small = reduced(true, max(estimate.shape[:2])) * (means[1] / max(means[0], 1e-30))
    return _outlined(picture(small, exposure), (small * exposure).max(axis=-1) > 1)


def _spheres(run: Artifacts, name: str) -> str | None:
    """Truth above, estimate below, the estimate scaled to the truth's mean."""
    truth, estimate = (run.rgb("evaluate", f"spheres/{name}_{which}") for which in ("truth", "estimate"))
    if truth is None or estimate is None:
        return None
    exposure = exposure_of(truth, truth.max(-1) > 0, 97.0)
    rows = [truth, estimate * (truth.mean() / max(float(estimate.mean()), 1e-30))]
    balls = [[np.repeat(np.repeat(ball, 2, 0), 2, 1) for ball in np.split(row, 3, axis=1)] for row in rows]
    discs = [[np.pad(disc(ball, exposure), ((4, 4), (0, 8), (0, 0))) for ball in row] for row in balls]
    return data_uri(np.concatenate([np.concatenate(row, axis=1) for row in discs]))
