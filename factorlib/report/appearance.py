"""Balls and reflectance maps of every material in every light, and the light itself."""

from __future__ import annotations

import msgspec
import numpy as np
from jaxtyping import Float

from factorlib.conventions import lat_long_solid_angles
from factorlib.images.picture import exposure_of, picture
from factorlib.report.artifacts import Artifacts
from factorlib.report.photos import ringed
from factorlib.report.png import data_uri, outline, reduced
from factorlib.results.metrics import ScoredLight
from factorlib.urm.observations import Observations

MAP_SIZE = 64
LEAST_OBSERVED = 0.002  # of a disc: fewer normals than this are not ringed


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


def balls(run: Artifacts, seen: dict[str, list[str]], exposure: dict[str, float]) -> list[list[Cell]]:
    """Rows of materials, columns of photos."""
    return [[_ball(run, m, p, m in seen[p], exposure[p]) for p in run.set.photos] for m in run.set.materials]


def _ball(run: Artifacts, material: str, photo: str, observed: bool, exposure: float) -> Cell:
    radiance = run.ball(photo, material)
    return Cell(material, photo, observed, None if radiance is None else data_uri(disc(reduced(radiance, 96), exposure)))


def disc(radiance: Float[np.ndarray, "n n 3"], exposure: float) -> np.ndarray:
    """Display values, transparent outside the disc that fills the picture."""
    height, width = radiance.shape[:2]
    y, x = ((np.arange(n) + 0.5) / n * 2 - 1 for n in (height, width))
    alpha = np.clip((1 - np.hypot(x[None], y[:, None])) * height / 2 + 0.5, 0, 1)
    return np.concatenate([picture(radiance, exposure), np.rint(255 * alpha)[..., None].astype(np.uint8)], axis=-1)


def reflectance_maps(run: Artifacts, photo: str, exposure: float) -> list[Cell]:
    """One cell per material: solved, with the observed normals ringed, and beside it what the photo measured."""
    observations = run.observations(photo)
    return [_map(run, photo, index, material, observations, exposure) for index, material in enumerate(run.set.materials)]


def _map(run: Artifacts, photo: str, index: int, material: str, observations: Observations | None, exposure: float) -> Cell:
    channels = run.reflectance_map(photo, material)
    rows = observations.material == index if observations is not None else np.zeros(0, bool)
    measured = data_uri(measured_map(observations.take(rows), exposure)) if rows.any() else None
    if channels is None:
        return Cell(material, photo, bool(rows.any()), None, measured)
    pixels = disc(np.stack([channels[c] for c in "RGB"], axis=-1), exposure)
    seen = channels.get("observed", np.zeros(pixels.shape[:2])) > 0.5
    if seen.mean() > LEAST_OBSERVED:
        inside = pixels[..., 3] > 0
        pixels[..., :3] = np.rint(255 * ringed(pixels[..., :3] / 255, seen | ~inside))
    return Cell(material, photo, bool(rows.any()), data_uri(pixels), measured)


def measured_map(observations: Observations, exposure: float) -> np.ndarray:
    """Mean radiance by normal, seen from the front, as RGBA; transparent where no normal was seen."""
    n, side = observations.normal, _side(len(observations))  # camera frame: x right, y down
    column, row = (np.clip(((n[:, k] + 1) / 2 * side).astype(int), 0, side - 1) for k in (0, 1))
    cell = row * side + column
    weight = np.bincount(cell, minlength=side**2)
    total = np.stack([np.bincount(cell, c, side**2) for c in observations.radiance.T], axis=-1)
    mean = (total / np.maximum(weight, 1)[:, None]).reshape(side, side, 3)
    alpha = np.where(weight > 0, 255, 0).astype(np.uint8).reshape(side, side, 1)
    return np.concatenate([picture(mean, exposure), alpha], axis=-1)


def _side(observations: int) -> int:
    """Cells across the disc: about two observations to a cell, at most `MAP_SIZE` across."""
    return int(np.clip(np.sqrt(observations * 2 / np.pi), 8, MAP_SIZE))


def light_row(run: Artifacts, name: str, photos: list[str], errors: dict[str, dict[str, ScoredLight]] | None) -> LightRow | None:
    """The row of light `name`; None where no such light was exported.  errors: its part of metrics.json"""
    radiance = run.illumination(name)
    if radiance is None:
        return None
    exposure = exposure_of(radiance, percentile=95.0)
    brightest, area = radiance.max(axis=-1) * exposure, lat_long_solid_angles(*radiance.shape[:2])[:, None]
    over, energy = brightest > 1, radiance.sum(axis=-1) * area
    true, known = run.true_illumination(name), run.coverage(name)
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


def _outlined(pixels: np.ndarray, over: np.ndarray) -> np.ndarray:
    found = pixels.copy()
    found[outline(over)] = (214, 40, 120)
    return found


def _true_map(true: np.ndarray, estimate: np.ndarray, exposure: float) -> np.ndarray:
    """The true map, scaled to the mean of the estimate: the overall scale is a matter of gauge."""
    area = [lat_long_solid_angles(*m.shape[:2])[:, None, None] / m.shape[1] for m in (true, estimate)]
    scale = float((estimate * area[1]).sum() / max((true * area[0]).sum(), 1e-30))
    small = reduced(true, max(estimate.shape[:2]))
    return _outlined(picture(small * scale, exposure), (small * scale * exposure).max(axis=-1) > 1)


def _spheres(run: Artifacts, name: str) -> str | None:
    """Truth above, estimate below, the estimate scaled to the truth's mean."""
    pair = [run.spheres(name, which) for which in ("truth", "estimate")]
    if any(p is None for p in pair):
        return None
    truth, estimate = pair
    rows = [truth, estimate * (truth.mean() / max(float(estimate.mean()), 1e-30))]
    exposure = exposure_of(truth, truth.max(-1) > 0, 97.0)
    discs = [[disc(np.repeat(np.repeat(ball, 2, 0), 2, 1), exposure) for ball in np.split(row, 3, axis=1)] for row in rows]
    gap = np.zeros((discs[0][0].shape[0] + 8, 8, 4), np.uint8)
    padded = [[np.concatenate([np.pad(d, ((4, 4), (0, 0), (0, 0))), gap], axis=1) for d in row] for row in discs]
    return data_uri(np.concatenate([np.concatenate(row, axis=1) for row in padded], axis=0))
