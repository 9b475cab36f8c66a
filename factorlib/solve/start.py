"""Where a solve starts: reflectances from median radiances, exposures from mean ones, constant lights.

The median radiance of material m in photo i is roughly light_i · reflectance_m per channel: a rank-one matrix with gaps, whose logarithm is
fitted as a sum by least squares.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from factorlib.model.blocks import Block
from factorlib.model.bounds import LEAST_REFLECTANCE
from factorlib.model.lights import Light, even_cells
from factorlib.model.materials import Materials
from factorlib.model.point import Point

BRIGHTEST_AT_START = 0.7  # reflectance of the brightest material at the start
ROUGHNESS, SPECULAR_SHARE = 0.4, 0.2  # of every material at the start
LEAST_RADIANCE = 1e-6  # of a block's mean


def starting_point(
    blocks: Sequence[Block],
    count: int,
    cells: int,
    roughness: float = ROUGHNESS,
    specular_share: float = SPECULAR_SHARE,
) -> Point:
    """Materials 0 … `count`−1 whose diffuse part explains median radiances, and one constant light of `cells` cells a block."""
    materials = starting_materials(blocks, count, specular_share, roughness)
    return Point(materials, [constant_light(block, materials, cells) for block in blocks])


def starting_materials(
    blocks: Sequence[Block], count: int, specular_share: float = SPECULAR_SHARE, roughness: float = ROUGHNESS
) -> Materials:
    """Materials whose diffuse part explains the median radiances and whose specular part is grey."""
    albedo = mean_albedo(blocks, count)
    diffuse = np.maximum(albedo * (1 - specular_share), 10 * LEAST_REFLECTANCE)
    specular = np.maximum(np.full((count, 3), specular_share * BRIGHTEST_AT_START / 2), 10 * LEAST_REFLECTANCE)
    return Materials(diffuse, specular, np.full(count, roughness))


def mean_albedo(blocks: Sequence[Block], count: int) -> Float[np.ndarray, "m 3"]:
    """Relative reflectance per material and channel, the largest being `BRIGHTEST_AT_START`; materials that no block shows get the median."""
    rows, right, weight, first = [], [], [], count
    for block in blocks:
        for k in range(len(block.photos)):
            for m in np.unique(block.material[block.photo == k]):
                of = (block.material == m) & (block.photo == k)
                row = np.zeros(count + sum(len(b.photos) for b in blocks))
                row[[m, first + k]] = 1
                rows.append(row)
                right.append(np.log(np.maximum(np.median(block.radiance[of], axis=0), LEAST_RADIANCE)))
                weight.append(np.sqrt(of.sum()))
        first += len(block.photos)
    weighted = np.array(rows) * np.array(weight)[:, None]
    logs = np.linalg.lstsq(weighted, np.array(right) * np.array(weight)[:, None], rcond=None)[0][:count]
    seen = np.array(rows)[:, :count].any(0)
    logs[~seen] = np.median(logs[seen], axis=0)
    return BRIGHTEST_AT_START * np.exp(logs - logs.max())


def constant_light(block: Block, materials: Materials, cells: int) -> Light:
    """The constant light that explains the mean radiance of a block's first photo, and the exposures of the others beside it."""
    reflectance = np.maximum((materials.diffuse + materials.specular)[block.material], LEAST_REFLECTANCE)
    logs = np.log(np.maximum(block.radiance, LEAST_RADIANCE) / reflectance)
    shown = [k for k in range(len(block.photos)) if (block.photo == k).any()]
    levels = np.zeros((len(block.photos), 3))
    levels[shown] = [np.log(np.mean(np.exp(logs[block.photo == k]), axis=0)) for k in shown]
    lobes = even_cells(cells)
    light = Light(lobes.axis, np.log(lobes.sharpness), np.ones((cells, 3)), (levels - levels[0]).mean(1))
    return light.with_log_radiance(np.repeat(levels[0][:, None], cells, axis=1))
