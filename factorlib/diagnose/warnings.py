"""What is missing or unusable in the observations, as sentences."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from factorlib.model.blocks import Block
from factorlib.model.components import connected_components


def unseen_materials(names: Sequence[str], blocks: Sequence[Block]) -> list[str]:
    """Materials that no photo shows; names: of all materials, in the order of their numbers."""
    observed = {int(m) for block in blocks for m in np.unique(block.material)}
    return [
        f"material '{name}' is observed in no photo: its reflectance is only a guess" for m, name in enumerate(names) if m not in observed
    ]


def photos_without_light(photos: Sequence[str], blocks: Sequence[Block]) -> list[str]:
    """Photos of which no observation is usable."""
    lit = {photo for block in blocks for photo in block.photos}
    return [f"photo '{photo}' has no valid observation and gets no light" for photo in sorted(set(photos) - lit)]


def unlinked_sets(names: Sequence[str], blocks: Sequence[Block]) -> list[str]:
    """Where photos fall into sets that share no material."""
    linked = [component for component in connected_components(blocks, len(names)) if component.illuminations]
    if len(linked) < 2:
        return []
    groups = "; ".join(f"{', '.join(lights)} (with {', '.join(names[m] for m in members)})" for members, lights in linked)
    return [
        f"the photos fall into {len(linked)} sets that share no material, so their reflectances cannot be compared: {groups}. "
        "A photo that shows a material of each would link them"
    ]
