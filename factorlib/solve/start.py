"""Where the joint descent starts: reflectances from mean radiances, one nearly constant lobe a light.

The mean radiance of material m in illumination i is roughly light_i · reflectance_m per channel: a rank-one matrix
with gaps, whose logarithm is fitted as a sum by least squares.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from factorlib.model.blocks import Block
from factorlib.model.bounds import LEAST_REFLECTANCE
from factorlib.model.lights import Light
from factorlib.model.materials import Materials

BRIGHTEST_AT_START = 0.7  # reflectance of the brightest material at the start; the gauge sets it in the end


def starting_materials(blocks: Sequence[Block], count: int, specular_share: float, roughness: float) -> Materials:
    """Materials whose diffuse part explains the mean radiances and whose specular part is grey."""
    albedo = mean_albedo(blocks, count)
    diffuse = np.maximum(albedo * (1 - specular_share), 10 * LEAST_REFLECTANCE)
    specular = np.maximum(np.full((count, 3), specular_share * BRIGHTEST_AT_START / 2), 10 * LEAST_REFLECTANCE)
    return Materials(diffuse, specular, np.full(count, roughness))


def mean_albedo(blocks: Sequence[Block], count: int) -> Float[np.ndarray, "m 3"]:
    """Relative reflectance per material and channel, the largest being `BRIGHTEST_AT_START`; materials that no block shows get the median."""
    rows, right, weight = [], [], []
    for i, block in enumerate(blocks):
        for m in np.unique(block.material):
            of = block.material == m
            row = np.zeros(count + len(blocks))
            row[[m, count + i]] = 1
            rows.append(row)
            right.append(np.log(np.maximum(np.median(block.radiance[of], axis=0), 1e-6)))
            weight.append(np.sqrt(of.sum()))
    weighted = np.array(rows) * np.array(weight)[:, None]
    logs = np.linalg.lstsq(weighted, np.array(right) * np.array(weight)[:, None], rcond=None)[0][:count]
    seen = np.array(rows)[:, :count].any(0)
    logs[~seen] = np.median(logs[seen], axis=0)
    return BRIGHTEST_AT_START * np.exp(logs - logs.max())


def starting_light(block: Block, materials: Materials) -> Light:
    """One broad lobe in front that gives the block's mean radiance."""
    reflectance = np.average(materials.diffuse[block.material], axis=0, weights=block.precision.mean(1))
    axis, sharpness = np.array([[0.0, 0.0, -1.0]]), 0.5
    weight = block.radiance.mean(0) / np.maximum(reflectance, 1e-6)
    return Light(axis, np.log([sharpness]), weight[None], np.zeros(len(block.photos)))
