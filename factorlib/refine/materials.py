"""The materials that a solve found, and which of them it knows."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool

from factorlib.errors import InputError
from factorlib.jsonfile import read_json
from factorlib.model.materials import Materials

UNKNOWN = 0.7  # standard error of a diffuse reflectance, in its range of 1: one that no photo shows has at least this


def known_materials(path: Path, names: Sequence[str]) -> tuple[Materials, Bool[np.ndarray, "m"]]:
    """In the order of `names`, and which are known; raises InputError for a file that is no table of them."""
    try:
        table = read_json(path)["materials"]
        rows = [[*table[name]["diffuse"], *table[name]["specular"], table[name]["roughness"]] for name in names]
        known = [min(table[name]["stderr"]["diffuse"]) < UNKNOWN for name in names]
    except (KeyError, TypeError) as error:
        raise InputError(f"not the materials of this set ({error!r})", file=path, cure="run the stage `solve` again") from None
    return Materials.of_vector(np.array(rows, dtype=float).reshape(-1)), np.array(known, dtype=bool)
