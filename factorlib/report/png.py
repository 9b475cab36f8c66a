"""Pictures inside the page: as data URIs, reduced, cropped and outlined."""

from __future__ import annotations

import base64

import numpy as np
from jaxtyping import Bool, Float, UInt8

from factorlib.images.picture import png_bytes


def data_uri(pixels: UInt8[np.ndarray, "h w c"]) -> str:
    """Pixels as a PNG in a `data:` URI, for the `src` of an image."""
    return "data:image/png;base64," + base64.b64encode(png_bytes(pixels)).decode("ascii")


def reduced(picture: Float[np.ndarray, "h w c"], longest: int) -> Float[np.ndarray, "H W c"]:
    """Area averages, so that no side is longer than `longest`; a small picture stays as it is."""
    height, width = picture.shape[:2]
    scale = min(1.0, longest / max(height, width))
    if scale == 1.0:
        return picture
    rows, columns = (_averaging(n, max(1, round(n * scale))) for n in (height, width))
    return np.einsum("Hh,hwc->Hwc", rows, np.einsum("Ww,hwc->hWc", columns, picture, optimize=True), optimize=True)


def box_of(mask: Bool[np.ndarray, "h w"], margin: float = 0.06) -> tuple[slice, slice]:
    """Rows and columns of the mask, with a margin of that fraction of its longer side; everything for an empty mask."""
    if not mask.any():
        return slice(0, mask.shape[0]), slice(0, mask.shape[1])
    spans = [np.nonzero(mask.any(axis=1 - axis))[0][[0, -1]] for axis in (0, 1)]
    extra = int(np.ceil(margin * max(b - a + 1 for a, b in spans)))
    return tuple(slice(max(0, a - extra), min(n, b + 1 + extra)) for (a, b), n in zip(spans, mask.shape, strict=True))


def outline(mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Pixels of the mask that touch its outside; the picture's border is not outside."""
    p = np.pad(mask, 1, mode="edge")
    return mask & ~(p[:-2, 1:-1] & p[2:, 1:-1] & p[1:-1, :-2] & p[1:-1, 2:])


def _averaging(source: int, target: int) -> Float[np.ndarray, "target source"]:
    """Row t holds the share of each source cell in target cell t."""
    edges = np.arange(target + 1) * (source / target)
    cells = np.arange(source)
    overlap = np.minimum(edges[1:, None], cells + 1) - np.maximum(edges[:-1, None], cells)
    return (np.maximum(overlap, 0) * (target / source)).astype(np.float32)
