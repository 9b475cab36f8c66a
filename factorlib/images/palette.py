"""Palette that gives each material a distinct colour in masks and tables, as near to its own as possible."""

import numpy as np
from jaxtyping import Float
from PIL.ImageColor import getrgb
from scipy.optimize import linear_sum_assignment

from factorlib.images.transfer import srgb_encode

PALETTE = (
    "#d1495b",
    "#2e8b57",
    "#3d6fb6",
    "#e0b13a",
    "#7d4f9e",
    "#3fb0c4",
    "#e07b39",
    "#8c6d46",
    "#9aa53a",
    "#e8e8e8",
    "#303438",
)


def nearest_tags(names: list[str], reflectance: Float[np.ndarray, "m 3"]) -> dict[str, str]:
    """Assign palette colours to materials with the least total distance, mostly of chroma.

    With more than eleven materials the palette is used again.

    >>> nearest_tags(["wine", "snow", "coal"], np.array([[0.5, 0.05, 0.05], [0.8, 0.8, 0.8], [0.03, 0.03, 0.03]]))
    {'wine': '#d1495b', 'snow': '#e8e8e8', 'coal': '#303438'}
    """
    palette = np.array([getrgb(tag) for tag in PALETTE]) / 255
    tags = {}
    for start in range(0, len(names), len(PALETTE)):
        difference = srgb_encode(np.clip(reflectance[start : start + len(PALETTE)], 0, 1))[:, None] - palette
        # squared distance of chroma, plus a tenth of that of brightness
        brightness = difference.mean(axis=-1, keepdims=True)
        distance = 3 * np.square(difference - brightness).sum(axis=-1) + 0.3 * 3 * np.square(brightness[..., 0])
        for row, column in zip(*linear_sum_assignment(distance), strict=True):
            tags[names[start + row]] = PALETTE[column]
    return tags
