"""Where the lobes of a light start: one nearly constant lobe."""

from __future__ import annotations

import numpy as np

from factorlib.model.blocks import Block
from factorlib.model.lights import Light
from factorlib.model.materials import Materials


def starting_light(block: Block, materials: Materials) -> Light:
    """One broad lobe in front that gives the block's mean radiance."""
    reflectance = np.average(materials.diffuse[block.material], axis=0, weights=block.precision.mean(1))
    axis, sharpness = np.array([[0.0, 0.0, -1.0]]), 0.5
    weight = block.radiance.mean(0) / np.maximum(reflectance, 1e-6)
    return Light(axis, np.log([sharpness]), weight[None], np.zeros(len(block.photos)))
