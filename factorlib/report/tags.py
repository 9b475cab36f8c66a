"""A colour for each material, to tell it in masks and tables: distinct, and as near to its own as can be."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.optimize import linear_sum_assignment

from factorlib.images.transfer import srgb_encode
from factorlib.report.artifacts import Artifacts
from factorlib.results.materials import Reflectance

PALETTE = ("#d1495b", "#2e8b57", "#3d6fb6", "#e0b13a", "#7d4f9e", "#3fb0c4", "#e07b39", "#8c6d46", "#9aa53a",
           "#e8e8e8", "#303438")  # fmt: skip
UNKNOWN = Reflectance((0.2,) * 3, (0.0,) * 3, 1.0)  # of a material that was not solved


def material_tags(run: Artifacts) -> dict[str, str]:
    """A colour "#rrggbb" of each material of the set, near to its diffuse one (to its specular one, for a metal)."""
    solved = run.solved().materials
    found = [solved.get(name, UNKNOWN) for name in run.set.materials]
    return nearest_tags(run.set.materials, np.array([np.add(m.diffuse, np.multiply(0.15, m.specular)) for m in found]))


def nearest_tags(names: list[str], reflectance: Float[np.ndarray, "m 3"]) -> dict[str, str]:
    """The assignment of palette to materials with the least distance, mostly of chroma; beyond eleven materials it starts again.

    >>> nearest_tags(["wine", "snow", "coal"], np.array([[0.5, 0.05, 0.05], [0.8, 0.8, 0.8], [0.03, 0.03, 0.03]]))
    {'wine': '#d1495b', 'snow': '#e8e8e8', 'coal': '#303438'}
    """
    palette = np.array([[int(tag[i : i + 2], 16) / 255 for i in (1, 3, 5)] for tag in PALETTE])
    tags: dict[str, str] = {}
    for start in range(0, len(names), len(PALETTE)):
        shown = srgb_encode(np.clip(reflectance[start : start + len(PALETTE)], 0, 1))
        distance = _distance(shown[:, None], palette)
        tags |= {names[start + row]: PALETTE[column] for row, column in zip(*linear_sum_assignment(distance), strict=True)}
    return tags


def _distance(a: Float[np.ndarray, "m 1 3"], b: Float[np.ndarray, "p 3"]) -> Float[np.ndarray, "m p"]:
    """Squared, of display values: colourfulness counts ten times as much as brightness."""
    difference = a - b
    brightness = difference.mean(axis=-1, keepdims=True)
    return 3 * np.square(difference - brightness).sum(axis=-1) + 0.3 * 3 * np.square(brightness[..., 0])
