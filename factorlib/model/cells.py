"""Cells of mirror directions: observations that see the same region of a light err alike."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int

HELD_OUT_CELL = 0.1  # size of the cells of mirror directions that are held out together


def mirror_directions(normal: Float[np.ndarray, "n 3"], view: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """2(n·o)n − o: where a mirror at the point would show the light from; all unit, in one frame."""
    return 2 * np.sum(normal * view, axis=1, keepdims=True) * normal - view


def mirror_cells(normal: Float[np.ndarray, "n 3"], view: Float[np.ndarray, "n 3"], size: float) -> Int[np.ndarray, "n"]:
    """A name of the cell, a cube of `size` cut by the unit sphere, in which each observation's mirror direction lies."""
    return np.floor((mirror_directions(normal, view) + 1) / size).astype(int) @ [1, 1_000, 1_000_000]


def held_out_by_cells(cell: Int[np.ndarray, "n"], material: Int[np.ndarray, "n"], share: float, seed: int) -> Bool[np.ndarray, "n"]:
    """About a `share` of the observations: all of randomly chosen cells.  Never all of a material.

    Neighbouring pixels err alike, so single pixels would not tell a lobe that the light needs from one that explains
    the error of a place.
    """
    names, number = np.unique(cell, return_inverse=True)
    chosen = (np.random.default_rng(seed).random(len(names)) < share)[number.reshape(-1)]
    return chosen & np.isin(material, material[~chosen])
