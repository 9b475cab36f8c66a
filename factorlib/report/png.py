"""Pictures inside the page: PNG files as bytes and data URIs, the same bytes for the same pixels, and their sizes."""

from __future__ import annotations

import base64
import struct
import zlib

import numpy as np
from jaxtyping import Bool, Float, UInt8

SIGNATURE = b"\x89PNG\r\n\x1a\n"
COLOUR_TYPE = {1: 0, 3: 2, 4: 6}  # channels -> PNG colour type


def png_bytes(pixels: UInt8[np.ndarray, "h w c"]) -> bytes:
    """A PNG of 1, 3 or 4 channels; rows are stored as Paeth differences (PNG specification, 9.4)."""
    height, width, channels = pixels.shape
    p = np.pad(pixels.astype(np.int16), ((1, 0), (1, 0), (0, 0)))
    left, up, corner = p[1:, :-1], p[:-1, 1:], p[:-1, :-1]
    estimate = left + up - corner
    far = [np.abs(estimate - t) for t in (left, up, corner)]
    nearest = np.where((far[0] <= far[1]) & (far[0] <= far[2]), left, np.where(far[1] <= far[2], up, corner))
    rows = ((p[1:, 1:] - nearest) & 255).astype(np.uint8).reshape(height, -1)
    data = np.concatenate([np.full((height, 1), 4, np.uint8), rows], axis=1).tobytes()
    header = struct.pack(">IIBBBBB", width, height, 8, COLOUR_TYPE[channels], 0, 0, 0)
    return SIGNATURE + _chunk(b"IHDR", header) + _chunk(b"IDAT", zlib.compress(data, 9)) + _chunk(b"IEND", b"")


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


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
