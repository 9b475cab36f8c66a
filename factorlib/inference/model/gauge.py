"""Gauge of a solution: connected components of materials and lights, and the rule that fixes their free factors.

The data leave one factor per channel and connected component free between reflectances and lights.  No factor is free
where surfaces light each other or photos show the surroundings, because these radiances are known, nor where a
reflectance or a light is known (`factorlib.inference.model.known`).  Such a component stays as it is.  A light that is
known up to one factor fixes the tint.

Tint   Lights are as near to grey as possible, as the paper's prior asks.  Let E_ic be the summed lobe energies of light
       i.  The factors s_c minimise Σ_i Σ_c (log s_c E_ic − mean_c log s_c E_ic)²: s_c is one over the geometric mean
       over lights of E_ic, and each light counts alike.  In logarithms the rule does not depend on the initial gauge.
       The paper sums weights, which are peak values.  One broad lobe and several sharper ones in its place have
       different summed weights, but equal summed energies.
Scale  The largest k_d + k_s of a component's materials is `BRIGHTEST`.  A bright material in a room reflects most of
       the light, as in most photographs of objects, and Mitsuba requires a value below one.  Interreflection and
       surroundings determine a scale to about a quarter of itself only.  Where a reflectance exceeds 1 at it, which no
       surface has, the component takes this scale, too, at its own tint.

Bounces  Interreflection alone determines the factors badly: on a hull, light from hidden surfaces comes from wrong
       places (a white box in the sun came out at .13, .20, .20 in place of .6, in too red a light).  The logarithm of a
       factor is therefore a mean of two, weighted by their precisions.  One is that of the solve.  The other is that of
       the priors on the mean tint of natural lights and on the brightness of the brightest material.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import msgspec
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components as components_of_graph

from factorlib.inference.model.blocks import Block
from factorlib.inference.model.known import KnownValues
from factorlib.inference.model.materials import Materials, Point
from factorlib.robust import TINY

BRIGHTEST = 0.9
# Median of the mean reflectance of a set's brightest material, and standard deviation of its logarithm.
MEDIAN_BRIGHTNESS = 0.69
BRIGHTNESS_DEVIATION = 0.16
# Standard deviation of the logarithm of a light's mean radiance, by channel, relative to grey: .11, .08 and .14 in 33
# captured maps (`studies.measured.captured_lights`).
TINT_DEVIATION = 0.12
# The same of a factor that interreflection alone determines: 7 to 50 % on data/eames and sets like it.
BOUNCE_DEVIATION = 0.25
# Least energy, as a share of a light's brightest channel: a light without blue does not decide how blue the others are.
LEAST_ENERGY = 1e-3
RULE = (
    "per connected component: channel factors make the geometric means over lights of their summed lobe energies "
    "grey (after the prior of Wang et al.); "
    f"the largest diffuse + specular reflectance is {BRIGHTEST}"
)
DETERMINED = (
    "; components in which interreflection or surroundings were seen have no free factor, and reflectances as these "
    "determine them, but none above 1; interreflection alone is weighed with the tints of natural lights and the "
    "brightness of bright materials"
)
GIVEN = "; in components with known materials or lights, scale and white balance come from these: {}"
UP_TO_SCALE = "; where lights are known up to a factor, white balance comes from them: {}"


class Component(NamedTuple):
    """Set of linked materials (by number) and illuminations (by name).

    Both are sorted, and either may be empty.
    """

    materials: tuple[int, ...]
    illuminations: tuple[str, ...]


def connected_components(blocks: Sequence[Block], materials: int) -> list[Component]:
    """Return all components of materials 0 … `materials`−1 and the blocks, sorted.

    Two materials are linked if one light illuminates both.  In each component one factor per channel is undetermined.
    """
    edges = [(m, materials + i) for i, block in enumerate(blocks) for m in np.unique(block.material).tolist()]
    material_nodes, light_nodes = np.array(edges, dtype=int).reshape(-1, 2).T
    size = materials + len(blocks)
    _, label = components_of_graph(
        coo_array((np.ones(len(material_nodes)), (material_nodes, light_nodes)), shape=(size, size)), directed=False
    )
    members = [np.flatnonzero(label == k).tolist() for k in np.unique(label)]
    return sorted(
        Component(
            tuple(n for n in nodes if n < materials),
            tuple(sorted(blocks[n - materials].name for n in nodes if n >= materials)),
        )
        for nodes in members
    )


def fix_gauge(point: Point, blocks: Sequence[Block], known: KnownValues = KnownValues()) -> Point:
    """Return the point in the gauge of this module; it predicts the same radiance.

    Args:
        point: Materials, and one light per block.
        blocks: Observations by illumination.
        known: Unknowns with given values.
    """
    lights = list(point.lights)
    diffuse = point.materials.diffuse.copy()
    specular = point.materials.specular.copy()
    names = [block.name for block in blocks]
    for members, illuminations in connected_components(blocks, len(point.materials)):
        linked_lights = [names.index(name) for name in illuminations]
        rows = list(members)
        factors = known.free_factors(members, illuminations)
        if not linked_lights or not factors:
            continue
        # log s_c from the geometric means of E_ic; reflectances take 1/s_c
        sums = np.array([lights[i].energy.sum(0) for i in linked_lights])
        level = np.log(np.maximum(sums, LEAST_ENERGY * np.maximum(sums.max(1, keepdims=True), TINY)))
        grey = (level - level.mean(1, keepdims=True)).mean(0)
        sum_of_parts = diffuse[rows] + specular[rows]
        factor = np.ones(3)
        if has_free_factor(blocks, illuminations):
            factor = np.exp(grey) if factors == 3 else factor
            factor = factor * BRIGHTEST / (factor * sum_of_parts).max()
        elif factors == 3 and all(blocks[i].background is None for i in linked_lights):
            factor = np.exp(_share_of_prior(TINT_DEVIATION / np.sqrt(len(linked_lights))) * grey)
            brightness = (factor * sum_of_parts).mean(1).max()
            factor = factor * (MEDIAN_BRIGHTNESS / brightness) ** _share_of_prior(BRIGHTNESS_DEVIATION)
        if (factor * sum_of_parts).max() > 1:
            factor = factor * BRIGHTEST / (factor * sum_of_parts).max()
        diffuse[rows] = diffuse[rows] * factor
        specular[rows] = specular[rows] * factor
        for i in linked_lights:
            lights[i] = msgspec.structs.replace(lights[i], weight=lights[i].weight / factor)
    return Point(Materials(diffuse, specular, point.materials.roughness), lights)


def _share_of_prior(deviation: float) -> float:
    """Return the weight of a prior of this standard deviation beside a factor that interreflection determines."""
    return BOUNCE_DEVIATION**2 / (BOUNCE_DEVIATION**2 + deviation**2)


def has_free_factor(blocks: Sequence[Block], illuminations: Sequence[str]) -> bool:
    """Return True if no block of these illuminations has interreflection or a background that fixes their factor."""
    return all(block.bounced is None and block.background is None for block in blocks if block.name in illuminations)
