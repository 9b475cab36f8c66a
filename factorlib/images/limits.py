"""How large a photo may be: asked of its header, before any pixel is read."""

from __future__ import annotations

from math import ceil
from pathlib import Path

from factorlib.errors import InputError

MOST_MEGAPIXELS = 200.0  # twice what the largest sensors have


def check_pixels(size: tuple[int, int], most_megapixels: float, path: str | Path, key: str | None = None) -> None:
    """size: (height, width).

    >>> check_pixels((30_000, 30_000), 200.0, "kitchen.png")
    Traceback (most recent call last):
    factorlib.errors.InputError: kitchen.png: has 30000 × 30000 pixels, 900 megapixels; at most 200 are read
      make photo and masks smaller, or allow it: SET="masks.most_megapixels=900"
    """
    height, width = size
    millions = height * width / 1e6
    if millions > most_megapixels:
        found = f"has {width} × {height} pixels, {millions:.4g} megapixels; at most {most_megapixels:g} are read"
        cure = f'make photo and masks smaller, or allow it: SET="masks.most_megapixels={ceil(millions)}"'
        raise InputError(found, file=path, key=key, cure=cure)
