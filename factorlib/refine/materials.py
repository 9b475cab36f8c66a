"""The materials that a solve found, and which of them are known well enough."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool

from factorlib.model.materials import Materials
from factorlib.results.materials import Solved

UNKNOWN = 0.7  # standard error of a diffuse reflectance, in its range of 1: one that no photo shows has at least this


def known_materials(solved: Sequence[Solved]) -> tuple[Materials, Bool[np.ndarray, " m"]]:
    """The materials as arrays, in order, and which of them are known."""
    rows = [[*one.diffuse, *one.specular, one.roughness] for one in solved]
    known = [min(one.stderr.diffuse) < UNKNOWN for one in solved]
    return Materials.of_vector(np.array(rows, dtype=float).reshape(-1)), np.array(known, dtype=bool)
