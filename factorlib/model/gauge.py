"""Fixing what the data cannot: one factor per channel and connected component, between reflectances and lights.

Tint   The paper's prior settles it: lights as near to grey as they can be.  With a_ic the summed lobe energies of
       light i over their mean of channels, the factors s_c minimise Σ_i Σ_c (s_c a_ic − 1)², so s_c = Σ_i a_ic / Σ_i a_ic².
       The paper sums weights.  But those are peaks: of one light, sums of two fits differ as one of its lobes is fitted by
       several sharper ones, while energies add up to what the light sends.
Scale  The largest k_d + k_s of a component's materials is `BRIGHTEST`: a bright material in the room reflects most of
       the light, which is what photographs of objects show, and Mitsuba needs it below one.
"""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import numpy as np
from jaxtyping import Float

from factorlib.model.blocks import Block
from factorlib.model.components import connected_components
from factorlib.model.lights import Light
from factorlib.model.materials import Materials
from factorlib.model.point import Point

BRIGHTEST = 0.9
RULE = (
    "per connected component: channel factors make the lights' summed lobe energies nearest to grey (after the prior of Wang et al.); "
    f"the largest diffuse + specular reflectance is {BRIGHTEST}"
)


def in_gauge(point: Point, blocks: Sequence[Block]) -> Point:
    """The same predicted radiance in the gauge stated above; one light per block."""
    materials, lights = point.materials, list(point.lights)
    diffuse, specular = materials.diffuse.copy(), materials.specular.copy()
    names = [block.name for block in blocks]
    for members, illuminations in connected_components(blocks, len(materials)):
        own = [names.index(name) for name in illuminations]
        if not own:
            continue
        rows = list(members)
        factor = 1 / _greying([lights[i] for i in own])  # multiplies reflectances
        factor = factor * BRIGHTEST / (factor * (diffuse[rows] + specular[rows])).max()
        diffuse[rows], specular[rows] = diffuse[rows] * factor, specular[rows] * factor
        for i in own:
            lights[i] = msgspec.structs.replace(lights[i], weight=lights[i].weight / factor)
    return Point(Materials(diffuse, specular, materials.roughness), lights)


def _greying(lights: Sequence[Light]) -> Float[np.ndarray, "3"]:
    sums = np.array([light.energy.sum(0) for light in lights])
    share = sums / np.maximum(sums.mean(1, keepdims=True), 1e-30)
    return np.clip(share.sum(0) / np.maximum((share**2).sum(0), 1e-30), 1e-3, 1e3)
