"""Connected components of the material × illumination matrix."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components as components_of_graph

from factorlib.model.blocks import Block


class Component(NamedTuple):
    """Materials (by number) and illuminations (by name) that are linked, both sorted; either may be empty."""

    materials: tuple[int, ...]
    illuminations: tuple[str, ...]


def connected_components(blocks: Sequence[Block], materials: int) -> list[Component]:
    """All components of materials 0 … `materials`−1 and the blocks, sorted.

    Two materials are linked if one light shows both.  In each component one factor per channel is not determined.
    """
    shown = [(m, materials + i) for i, block in enumerate(blocks) for m in np.unique(block.material).tolist()]
    first, second = np.array(shown, dtype=int).reshape(-1, 2).T
    size = materials + len(blocks)
    _, label = components_of_graph(
        coo_array((np.ones(len(first)), (first, second)), shape=(size, size)), directed=False
    )
    members = [np.flatnonzero(label == k).tolist() for k in np.unique(label)]
    return sorted(
        Component(
            tuple(n for n in nodes if n < materials),
            tuple(sorted(blocks[n - materials].name for n in nodes if n >= materials)),
        )
        for nodes in members
    )
