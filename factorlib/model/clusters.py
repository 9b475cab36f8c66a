"""Observations that mirror the same region of a light, whose errors are similar: what is held out together, and clusters of residuals."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Int

from factorlib.geometry.sphere import mirror_cells
from factorlib.model.blocks import Block

HELD_OUT_CELL = 0.1  # size of the cells of mirror directions that are held out together
CLUSTER = 0.35  # size of a cluster's cell of mirror directions: 20°


def held_out_by_cells(
    cell: Int[np.ndarray, " n"], material: Int[np.ndarray, " n"], share: float, seed: int
) -> Bool[np.ndarray, " n"]:
    """Which observations are held out: all of randomly chosen cells, a `share` of the cells, but never all of a material.

    Neighbouring pixels have similar errors.  If single pixels were held out, a lobe that only fits the error of a place would
    explain them as well as a lobe that the light needs.
    """
    names, number = np.unique(cell, return_inverse=True)
    chosen = (np.random.default_rng(seed).random(len(names)) < share)[number.reshape(-1)]
    return chosen & np.isin(material, material[~chosen])


def clusters_of(block: Block) -> Int[np.ndarray, " n"]:
    """The number, from 0, of the cluster in which each observation's residual depends on others."""
    return np.unique(mirror_cells(block.normal, block.view, CLUSTER), return_inverse=True)[1].reshape(-1)
