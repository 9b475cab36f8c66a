"""The rows of the page that set each photo beside its re-synthesis."""

from __future__ import annotations

import msgspec
import numpy as np
from jaxtyping import Bool, Float, UInt8

from factorlib.evaluate.resynthesis import agreeing_pixels
from factorlib.images.picture import picture, png_bytes
from factorlib.images.transfer import srgb_encode
from factorlib.report.artifacts import Artifacts, Channels, Picture
from factorlib.report.png import box_of, data_uri, outline, reduced
from factorlib.results.metrics import PhotoErrors

AMPLIFICATION = 4
UNCOUNTED = np.array([0.45, 0.38, 0.62])  # sRGB: in the mask, but not compared
DISAGREES = np.array([0.92, 1.0, 0.0])


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


def longest_side(photos: int) -> int:
    """Pixels of a panel's longer side: smaller where there are many photos, so that the page stays light."""
    return 440 if photos <= 12 else 300


def photo_row(run: Artifacts, name: str, tags: dict[str, str], errors: PhotoErrors | None) -> PhotoRow:
    """`tags`: the colour of each material in masks; `errors`: the photo's entry of the metrics."""
    masks, geometry, resynthesis = run.masks(name), run.geometry(name), run.resynthesis(name)
    shown = np.rint(masks["label"]) > 0
    box, longest = box_of(shown), longest_side(len(run.set.photos))
    cut = [{k: v[box] for k, v in channels.items()} for channels in (masks, geometry)]
    exposure = errors.exposure if errors else 1.0
    photo = np.nan_to_num(np.stack([cut[0][c] for c in "RGB"], axis=-1), posinf=0, neginf=0)
    panels = [
        _panel("photo", _display(photo, exposure), longest),
        _panel("materials", _labels(*cut, photo * exposure, [tags[m] for m in run.set.materials]), longest),
    ]
    if resynthesis is not None:
        found = np.nan_to_num(resynthesis[box], posinf=0, neginf=0)
        panels.append(_panel("re-synthesis", _cut_out(_display(found, exposure), _explained(*cut)), longest))
        panels.append(_panel("difference", _difference(photo, found, exposure, *cut), longest))
    return PhotoRow(name, run.illumination_of(name), panels, errors)


def _display(radiance: Float[np.ndarray, "h w 3"], exposure: float) -> Float[np.ndarray, "h w 3"]:
    return picture(radiance, exposure).astype(np.float32) / 255


def _panel(title: str, display: Float[np.ndarray, "h w c"], longest: int) -> Panel:
    pixels = np.rint(255 * np.clip(reduced(display, longest), 0, 1)).astype(np.uint8)
    return Panel(title, data_uri(pixels), pixels)


def _cut_out(display: Float[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "h w 4"]:
    """Transparent outside the mask."""
    return np.concatenate([display, mask[..., None]], axis=-1)


def _explained(masks: Channels, geometry: Channels) -> Bool[np.ndarray, "h w"]:
    return (masks["label"] > 0.5) & (np.rint(masks["label"]) == np.rint(geometry["label"]))


def _labels(masks: Channels, geometry: Channels, photo: np.ndarray, tags: list[str]) -> Float[np.ndarray, "h w 3"]:
    """Materials tinted on a grey photo (already exposed); yellow where mesh and mask name different ones."""
    grey = srgb_encode(np.clip(photo.mean(axis=-1), 0, 1))[..., None] * np.ones(3)
    label = np.rint(masks["label"]).astype(int)
    colours = np.array([[0.0, 0, 0], *([int(tag[i : i + 2], 16) / 255 for i in (1, 3, 5)] for tag in tags)])
    shown = np.where((label > 0)[..., None], 0.45 * grey + 0.55 * colours[label], 0.3 + 0.5 * grey)
    shown[(np.rint(geometry["label"]) != label) & (masks.get("left_out", 0 * label) < 0.5)] = DISAGREES
    return shown


def _difference(photo: Picture, found: Picture, exposure: float, masks: Channels, geometry: Channels) -> Float[np.ndarray, "h w 4"]:
    """Grey where equal, brighter where the re-synthesis is too bright, in display values; uncounted pixels violet."""
    shown = 0.5 + AMPLIFICATION * (_display(found, exposure) - _display(photo, exposure))
    clipped = np.any([masks[f"clipped.{c}"] > 0.5 for c in "RGB"], axis=0)
    shown[~agreeing_pixels(masks, geometry) | clipped] = UNCOUNTED
    return _cut_out(np.clip(shown, 0, 1), masks["label"] > 0.5)


def ringed(display: Float[np.ndarray, "h w 3"], mask: np.ndarray) -> Float[np.ndarray, "h w 3"]:
    """The outline of a mask drawn into a picture, white on dark and black on bright."""
    line = outline(mask)
    found = display.copy()
    found[line] = np.where(display[line].mean(axis=-1, keepdims=True) > 0.5, 0.0, 1.0)
    return found


def strip(row: PhotoRow) -> bytes:
    """A row's panels side by side on white, as a PNG."""
    return png_bytes(np.concatenate([on_white(panel.pixels) for panel in row.panels], axis=1))


def on_white(pixels: UInt8[np.ndarray, "h w c"]) -> UInt8[np.ndarray, "h w 3"]:
    """A picture with or without transparency, laid on white."""
    alpha = pixels[..., 3:].astype(np.float32) / 255 if pixels.shape[2] == 4 else 1.0
    return np.rint(pixels[..., :3] * alpha + 255 * (1 - alpha)).astype(np.uint8)
