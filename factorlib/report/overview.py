"""One picture of a run for a README: a column per photo, with photo, re-synthesis, light, and a ball of each material."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import UInt8

from factorlib.images.picture import exposure_of, picture, png_bytes
from factorlib.report.appearance import disc, exposures
from factorlib.report.artifacts import Artifacts
from factorlib.report.photos import PhotoRow, on_white
from factorlib.report.png import reduced

COLUMN, GAP = 200, 8  # pixels
MOST_PHOTOS = 8

Pixels = UInt8[np.ndarray, "_ _ 3"]


def overview(run: Artifacts, rows: Sequence[PhotoRow]) -> bytes:
    """A PNG of the first eight photos at most, on white."""
    exposure = exposures(run)
    shown = rows[:MOST_PHOTOS]
    height = min(COLUMN * 3 // 2, max(round(COLUMN * p.pixels.shape[0] / p.pixels.shape[1]) for row in shown for p in row.panels))
    columns = [_column(run, row, exposure[row.name], height) for row in shown]
    tallest = max(len(c) for c in columns)
    even = [np.pad(c, ((0, tallest - len(c)), (0, GAP), (0, 0)), constant_values=255) for c in columns]
    return png_bytes(np.concatenate(even, axis=1)[:, :-GAP])


def _column(run: Artifacts, row: PhotoRow, exposure: float, height: int) -> Pixels:
    panels = {panel.title: panel.pixels for panel in row.panels}
    cells = [_fitted(panels[t], height, COLUMN) for t in ("photo", "re-synthesis") if t in panels]
    light = run.illumination(row.illumination)
    if light is not None:
        cells.append(_fitted(picture(light, exposure_of(light, percentile=95.0)), COLUMN // 2, COLUMN))
    found = [run.ball(row.name, material) for material in run.set.materials]
    balls = [_fitted(disc(b, exposure), COLUMN // 2 - GAP, COLUMN // 2 - GAP // 2) for b in found if b is not None]
    for k in range(0, len(balls), 2):
        pair = np.concatenate(balls[k : k + 2], axis=1)
        cells.append(np.pad(pair, ((0, 0), (0, COLUMN - pair.shape[1]), (0, 0)), constant_values=255))
    return np.concatenate([np.pad(c, ((0, GAP), (0, 0), (0, 0)), constant_values=255) for c in cells], axis=0)[:-GAP]


def _fitted(pixels: UInt8[np.ndarray, "_ _ _"], height: int, width: int) -> Pixels:
    """In the middle of a white cell, as large as fits; what is smaller than the cell is enlarged by whole pixels."""
    shown = on_white(pixels).astype(np.float32)
    times = -(-max(height, width) // min(shown.shape[:2]))
    shown = np.repeat(np.repeat(shown, times, axis=0), times, axis=1) if times > 1 else shown
    scale = min(height / shown.shape[0], width / shown.shape[1])
    shown = reduced(shown, max(1, int(scale * max(shown.shape[:2]))))
    cell = np.full((height, width, 3), 255, np.uint8)
    top, left = (height - shown.shape[0]) // 2, (width - shown.shape[1]) // 2
    cell[top : top + shown.shape[0], left : left + shown.shape[1]] = np.rint(shown)
    return cell
