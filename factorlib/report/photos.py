"""Each photo beside its re-synthesis: a row of the page, a strip as PNG, and one picture of the whole run."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import numpy as np
from jaxtyping import Float, UInt8

from factorlib.evaluate.resynthesis import agreeing_pixels
from factorlib.images.palette import nearest_tags, rgb_of
from factorlib.images.picture import exposure_of, picture, png_bytes
from factorlib.images.transfer import srgb_encode
from factorlib.report.appearance import disc, exposures
from factorlib.report.artifacts import Artifacts, Channels
from factorlib.report.png import box_of, data_uri, reduced
from factorlib.results.materials import Reflectance
from factorlib.results.metrics import PhotoErrors

AMPLIFICATION = 4
UNCOUNTED = np.array([0.45, 0.38, 0.62])  # sRGB: in the mask, but not compared
DISAGREES = np.array([0.92, 1.0, 0.0])
COLUMN, GAP, MOST_PHOTOS = 200, 8, 8  # of the overview: pixels, pixels, photos
UNKNOWN = Reflectance((0.2,) * 3, (0.0,) * 3, 1.0)  # of a material that was not solved

Display = Float[np.ndarray, "h w c"]
Pixels = UInt8[np.ndarray, "h w 3"]


class Panel(msgspec.Struct, frozen=True):
    """A picture of a photo's row: its pixels, sRGB-encoded, and the same as a `data:` URI."""

    title: str
    uri: str
    pixels: UInt8[np.ndarray, "h w c"]


class PhotoRow(msgspec.Struct, frozen=True):
    """One photo: four panels of the same crop, and its errors, where there are any."""

    name: str
    illumination: str
    panels: list[Panel]
    errors: PhotoErrors | None


def material_tags(run: Artifacts) -> dict[str, str]:
    """A colour "#rrggbb" of each material of the set, near to its diffuse one (to its specular one, for a metal)."""
    solved = run.solved().materials
    reflectances = [solved.get(name, UNKNOWN) for name in run.set.materials]
    colours = [np.add(m.diffuse, np.multiply(0.15, m.specular)) for m in reflectances]
    return nearest_tags(run.set.materials, np.array(colours))


def longest_side(photos: int) -> int:
    """Pixels of a panel's longer side: smaller where there are many photos, so that the page stays light."""
    return 440 if photos <= 12 else 300


def photo_row(run: Artifacts, name: str, tags: dict[str, str], errors: PhotoErrors | None) -> PhotoRow:
    """`tags`: the colour of each material in masks; `errors`: the photo's entry of the metrics."""
    masks, geometry = run.exr("masks", name), run.exr("align", name)
    resynthesis, exposure = run.rgb("render", f"resynthesis/{name}"), errors.exposure if errors else 1.0
    box, longest = box_of(np.rint(masks["label"]) > 0), longest_side(len(run.set.photos))
    masks, geometry = ({k: v[box] for k, v in channels.items()} for channels in (masks, geometry))
    photo = np.nan_to_num(np.stack([masks[c] for c in "RGB"], axis=-1), posinf=0, neginf=0)
    shown, in_mask = _display(photo, exposure), masks["label"] > 0.5
    panels = {"photo": shown, "materials": _labels(masks, geometry, photo * exposure, list(tags.values()))}
    if resynthesis is not None:
        again = _display(np.nan_to_num(resynthesis[box], posinf=0, neginf=0), exposure)
        explained = in_mask & (np.rint(masks["label"]) == np.rint(geometry["label"]))
        panels["re-synthesis"] = np.concatenate([again, explained[..., None]], axis=-1)
        difference = _difference(shown, again, masks, geometry)
        panels["difference"] = np.concatenate([difference, in_mask[..., None]], axis=-1)
    pixels = {
        title: np.rint(255 * np.clip(reduced(display, longest), 0, 1)).astype(np.uint8)
        for title, display in panels.items()
    }
    row = [Panel(title, data_uri(each), each) for title, each in pixels.items()]
    return PhotoRow(name, run.illumination_of(name), row, errors)


def _display(radiance: Float[np.ndarray, "h w 3"], exposure: float) -> Display:
    return picture(radiance, exposure).astype(np.float32) / 255


def _labels(masks: Channels, geometry: Channels, photo: np.ndarray, tags: list[str]) -> Display:
    """Materials tinted on a grey photo (already exposed); yellow where mesh and mask name different ones."""
    grey = srgb_encode(np.clip(photo.mean(axis=-1), 0, 1))[..., None] * np.ones(3)
    label = np.rint(masks["label"]).astype(int)
    colours = np.array([(0, 0, 0), *(rgb_of(tag) for tag in tags)]) / 255
    shown = np.where((label > 0)[..., None], 0.45 * grey + 0.55 * colours[label], 0.3 + 0.5 * grey)
    shown[(np.rint(geometry["label"]) != label) & (masks.get("left_out", 0 * label) < 0.5)] = DISAGREES
    return shown


def _difference(photo: Display, again: Display, masks: Channels, geometry: Channels) -> Display:
    """Grey where equal, brighter where the re-synthesis is too bright; uncounted pixels violet."""
    shown = 0.5 + AMPLIFICATION * (again - photo)
    clipped = np.any([masks[f"clipped.{c}"] > 0.5 for c in "RGB"], axis=0)
    shown[~agreeing_pixels(masks, geometry) | clipped] = UNCOUNTED
    return np.clip(shown, 0, 1)


def strip(row: PhotoRow) -> bytes:
    """A row's panels side by side on white, as a PNG."""
    return png_bytes(np.concatenate([on_white(panel.pixels) for panel in row.panels], axis=1))


def on_white(pixels: UInt8[np.ndarray, "h w c"]) -> Pixels:
    """A picture with or without transparency, laid on white."""
    alpha = pixels[..., 3:].astype(np.float32) / 255 if pixels.shape[2] == 4 else 1.0
    return np.rint(pixels[..., :3] * alpha + 255 * (1 - alpha)).astype(np.uint8)


def _whitened(pixels: Pixels, down: int, right: int) -> Pixels:
    return np.pad(pixels, ((0, down), (0, right), (0, 0)), constant_values=255)


def overview(run: Artifacts, rows: Sequence[PhotoRow]) -> bytes:
    """A PNG on white for a README: a column per photo (the first eight), with photo, re-synthesis, light, and balls."""
    exposure, shown = exposures(run), rows[:MOST_PHOTOS]
    tallest = max(round(COLUMN * p.pixels.shape[0] / p.pixels.shape[1]) for row in shown for p in row.panels)
    columns = [_column(run, row, exposure[row.name], min(COLUMN * 3 // 2, tallest)) for row in shown]
    height = max(len(column) for column in columns)
    return png_bytes(np.concatenate([_whitened(c, height - len(c), GAP) for c in columns], axis=1)[:, :-GAP])


def _column(run: Artifacts, row: PhotoRow, exposure: float, height: int) -> Pixels:
    cells = [_fitted(p.pixels, height, COLUMN) for p in row.panels if p.title in ("photo", "re-synthesis")]
    light = run.rgb("export", f"illumination/{row.illumination}")
    if light is not None:
        cells.append(_fitted(picture(light, exposure_of(light, percentile=95.0)), COLUMN // 2, COLUMN))
    balls = [run.rgb("render", f"materials/{row.name}/{material}") for material in run.set.materials]
    size = COLUMN // 2 - GAP, COLUMN // 2 - GAP // 2
    balls = [_fitted(disc(ball, exposure), *size) for ball in balls if ball is not None]
    for k in range(0, len(balls), 2):
        pair = np.concatenate(balls[k : k + 2], axis=1)
        cells.append(_whitened(pair, 0, COLUMN - pair.shape[1]))
    return np.concatenate([_whitened(cell, GAP, 0) for cell in cells])[:-GAP]


def _fitted(pixels: UInt8[np.ndarray, "h w c"], height: int, width: int) -> Pixels:
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
